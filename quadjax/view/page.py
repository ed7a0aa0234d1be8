"""Self-contained pages, in a notebook or the browser: HTML with the script, style and data."""

import base64
import functools
import hashlib
import html
import json
import sys
import tempfile
import warnings
import webbrowser
from pathlib import Path
from typing import Any

import jinja2

from quadjax import __version__
from quadjax.core.files import write_text

ASSETS = Path(__file__).parent / "assets"
HEIGHT = 560  # px, of a page in a notebook


def page(record: dict[str, Any]) -> str:
    """The HTML of a page.

    The page loads nothing: its security policy allows only its own script and style, identified by
    their hashes. Text of the record is shown as text.

    Args:
        record: of ``page_record``.
    """
    script, css = _asset("viewer.js"), _asset("viewer.css")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(css)}; "
        f"img-src data: blob:; connect-src 'none'"
    )
    data = json.dumps(record, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":  # no tag or comment begins or ends in the data
        data = data.replace(letter, f"\\u{ord(letter):04x}")
    return _template().render(
        version=__version__,
        policy=policy,
        title=html.escape(str(record.get("title", "quadjax"))),
        css=css,
        data=data,
        script=script,
        license=_asset("three.LICENSE"),
    )


def write_page(path: Path | str, record: dict[str, Any]) -> None:
    """Write a page as one HTML file.

    Raises:
        InputError: a path that cannot be written.
    """
    write_text(path, page(record))


def frame(record: dict[str, Any], height: int = HEIGHT) -> str:
    """The page of a record as an ``iframe`` of some height, px, for a notebook or another page."""
    source = html.escape(page(record), quote=True)
    return (
        f'<iframe srcdoc="{source}" sandbox="allow-scripts" allow="fullscreen" '
        f'style="width: 100%; height: {height}px; border: 0"></iframe>'
    )


def show(record: dict[str, Any], path: Path | str | None = None) -> None:
    """Show a page in the notebook that runs this process, else in the browser.

    Args:
        record: of ``page_record``.
        path: of the HTML file that the browser opens; a temporary file if not given.
    """
    if path is None and _in_notebook():
        from IPython.display import HTML, display

        with warnings.catch_warnings():  # IPython suggests an IFrame, which needs a file
            warnings.filterwarnings("ignore", "Consider using IPython.display.IFrame")
            display(HTML(frame(record)))
        return
    if path is None:
        path = Path(tempfile.mkdtemp(prefix="quadjax-")) / "flights.html"
    write_page(path, record)
    webbrowser.open(Path(path).resolve().as_uri())


def _in_notebook() -> bool:
    """Whether a Jupyter kernel runs this process."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")


@functools.cache
def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


@functools.cache
def _template() -> jinja2.Template:
    return jinja2.Template(_asset("page.html"), keep_trailing_newline=True)


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
