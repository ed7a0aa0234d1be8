"""Pages in a notebook or the browser."""

import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import Any

from quadjax.view.page import frame, write_page


def show(record: dict[str, Any], path: Path | str | None = None) -> None:
    """Show a page in the notebook that runs this process, else in the browser.

    Args:
        record: of a ``Scene``.
        path: of the HTML file that the browser opens; a temporary file if not given.
    """
    if path is None and in_notebook():
        from IPython.display import HTML, display

        display(HTML(frame(record)))
        return
    if path is None:
        folder = tempfile.mkdtemp(prefix="quadjax-")
        path = Path(folder) / "flights.html"
    write_page(path, record)
    webbrowser.open(Path(path).resolve().as_uri())


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this process."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")
