"""Write the tables of the pages from the rows of benchmarks/results (make results).

With arguments, it first changes rows:

- ``measure ROW [POLICY...]``: fly policies, files or folders of runs, and replace the numbers of a
  row. That of a shipped policy needs no POLICY. A new row begins as its name and settings.
- ``keep ROW``: the row stays, and its table says which former settings it was measured with.
- ``restamp``: after a change of structure, replace the hashes of all rows. Keys of their settings
  may come and go, but no value may change, and no frozen number (``taskset -c 0``, minutes).
"""

from collections.abc import Sequence

from benchmarks import rows
from benchmarks.lap_rows import flown
from benchmarks.pages import PAGES, render
from benchmarks.settings import ABSENT, Tree
from quadjax.cli import script
from quadjax.core.errors import InputError, short
from quadjax.core.files import read_text, write_text

LAPS = ("presets", "shipped", "body", "table1", "published")  # files with rows of lap times


def find(name: str, files: Sequence[str]) -> tuple[str, Tree]:
    """The file of a row, and the row."""
    every = {f"{file}/{row['name']}": (file, row) for file in files for row in rows.read(file)}
    found = [key for key, (_, row) in every.items() if name in (key, row["name"])]
    if len(found) != 1:
        allowed = ", ".join(found or every)
        raise InputError(f"{name}: {len(found)} rows have this name, allowed: {allowed}")
    return every[found[0]]


def keep(name: str) -> None:
    """Write the former settings of a row into its key ``kept``."""
    file, row = find(name, rows.names())
    if not (changed := rows.changes(row)):
        raise InputError(f"{name}: measured with its present settings")
    texts = [f"`{key}={short(then, text=str)}`" for key, (then, _) in changed.items()]
    rows.write(file, [row | {"kept": f"measured with former settings, {', '.join(texts)}"}])


def restamp() -> None:
    """Replace the hashes of rows whose settings have another structure and the same numbers."""
    from tests.frozen import __main__ as frozen  # with the tools of the tests

    every = [(file, row) for file in rows.names() for row in rows.read(file)]
    for file, row in (stale := [(file, row) for file, row in every if rows.stale(row)]):
        for key, (then, now) in rows.changes(row).items():
            if ABSENT not in (then, now) and not key.startswith("policy."):
                raise InputError(f"{file}/{row['name']}: {key} was {short(then)}, is {short(now)}")
    if stale and frozen.machine() not in [document["machine"] for document in frozen.read()]:
        raise InputError("restamp: no frozen numbers of this kind of machine, allowed: some")
    if stale and frozen.compare(list(frozen.PARTS)):
        raise InputError("restamp: frozen numbers differ, allowed: no difference")
    for file, row in stale:
        rows.write(file, [row])


def results(*words: str) -> None:
    """Change rows as the arguments say, if any, and write the tables of the pages."""
    match words:
        case ():
            pass
        case ("measure", name, *policies):
            file, row = find(name, LAPS)
            rows.write(file, [flown(row, policies)])
        case ("keep", name):
            keep(name)
        case ("restamp",):
            restamp()
        case _:
            raise InputError(f"{words[0]}: allowed: measure ROW [POLICY...], keep ROW, restamp")
    data = {name: rows.read(name) for name in rows.names()}
    for page in PAGES:
        write_text(page, render(data, read_text(page)))


if __name__ == "__main__":
    script(results)
