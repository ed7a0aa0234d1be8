"""Tables in Markdown, and as plain text."""

import io
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table


def table(rows: Sequence[Sequence[str]]) -> str:
    """A table of cells; the first row is the line of titles. No bracket becomes a link."""
    cells = [[cell.replace("|", "\\|").replace("][", "]\\[") for cell in row] for row in rows]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def render_lines(table: Table) -> list[str]:
    """A table as lines of text without colors, of any width, in a notebook too."""
    stream = io.StringIO()
    Console(file=stream, width=10**4, color_system=None, force_jupyter=False).print(table)
    return [line.rstrip() for line in stream.getvalue().rstrip().splitlines()]
