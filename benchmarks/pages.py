"""The pages of the documentation, with the tables of the rows.

A page has a table between ``<!-- results: NAME -->`` and ``<!-- end -->``. Below it stands what
rows with ``kept`` were measured with. The table ``measured`` has commit and machine of all rows
in the files of the other tables of its page.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from textwrap import fill

from benchmarks.columns import cell
from benchmarks.settings import Tree
from benchmarks.tables import TABLES, Data, Table
from quadjax.core.markdown import table
from quadjax.core.resources import PRETRAINED

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", PRETRAINED / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OF_ONE = re.compile(r", (drone|seed) \d+")
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n(\n?)).*?(<!-- end -->)", re.DOTALL)


def drawn(made: Table, data: Data) -> str:
    """A table with a line for each row, and a line below it for each that is kept."""
    columns = [text.rpartition("=") for text in made.columns.split("|")]
    titles = [title or column for title, _, column in columns]
    rows = data[made.file] if made.rows is None else made.rows(data)
    cells = [[cell(row, column) for *_, column in columns] for row in rows]
    notes = [f"{line[0]}: {row['kept']}." for row, line in zip(rows, cells) if "kept" in row]
    return "\n\n".join([table([titles, *cells]), *(fill(note, 100) for note in notes)])


def measured(rows: Iterable[Tree]) -> str:
    """Commit and machine of rows, a line for all that share them, each drone and seed once."""
    groups: dict[str, dict[str, None]] = {}
    for row in (row for row in rows if "machine" in row):
        names = groups.setdefault(f"- `{row['commit']}`, {row['machine']}", {})
        names[f"`{OF_ONE.sub('', row['name'])}`"] = None
    lines = [f"{key}: {', '.join(names)}" for key, names in groups.items()]
    return "\n".join(fill(line, 100, subsequent_indent="  ") for line in lines)


def render(data: Data, page: str) -> str:
    """A page with the tables of the data."""
    of_page = {match[2]: TABLES.get(match[2]) for match in BLOCK.finditer(page)}
    rows = [row for made in of_page.values() if made and made.file for row in data[made.file]]

    def block(match: re.Match[str]) -> str:
        made = of_page[match[2]]
        text = measured(rows) if made is None else drawn(made, data)
        return f"{match[1]}{text}\n{match[3]}{match[4]}"

    return BLOCK.sub(block, page)
