"""List the presets that ``quadjax train``, ``quadjax config`` and ``quadjax.load`` take by name."""

import textwrap
from collections.abc import Sequence

from quadjax.cli.arguments import Parser, parse
from quadjax.core.resources import CONFIGS, preset_names


def main(arguments: Sequence[str] | None = None) -> None:
    """Print name and description of every preset."""
    parse(Parser("presets", description=__doc__), arguments)
    names = preset_names()
    width = max(map(len, names))
    for name in names:
        start = f"{name:<{width}}  "
        print(textwrap.fill(start + _description(name), 79, subsequent_indent=" " * len(start)))


def _description(name: str) -> str:
    """The first sentence of the comment at the top of a preset's file."""
    text = []
    for line in (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        text.append(line.lstrip("# "))
    return " ".join(text).split(". ")[0].removesuffix(".")
