"""The page of results and the README have the numbers of benchmarks/results.json."""

import json
import re

from benchmarks import results
from tests.docs.pages import ROOT

DATA = json.loads(results.FILE.read_text(encoding="utf-8"))
NUMBER = re.compile(r"\d+(?:\.\d+)?")
PAGE = results.PAGE.read_text(encoding="utf-8")


def test_the_page_has_the_tables_of_the_file():
    assert results.render(DATA, PAGE) == PAGE, "run: make results"
    tables = {*results.TABLES, "body", "measured"}
    assert set(re.findall(r"<!-- results: (\w+) -->", PAGE)) == tables
    changed = json.loads(json.dumps(DATA))
    times = changed["presets"][0]["total"]["mean"]
    times[:] = [time - 0.01 for time in times]
    assert results.render(changed, PAGE) != PAGE


def test_a_row_has_a_number_for_each_seed():
    for row in (row for table in results.TABLES.values() for row in DATA[table[0]]):
        columns = [*row["total"].values(), *row["finished"].values()]
        assert {len(column) for column in columns} == {len(row.get("seeds", [0]))}, row["name"]
        assert all(0 <= n <= row["flights"] for c in row["finished"].values() for n in c)


def test_the_readme_has_numbers_of_the_file():
    """The first words of a row of results in the README are the name of a row of the file."""
    rows = {row["name"]: row for row in DATA["presets"]}
    titles = "|".join(results.TABLES[name][1] for name in ("presets", "training")).split("|")
    compared = 0
    for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines():
        name, _, cells = line.removeprefix("| `").partition("`")
        if line.startswith("| `") and name in rows:
            texts = " ".join(results.COLUMNS[title](rows[name]) for title in titles)
            assert set(NUMBER.findall(cells)) <= set(NUMBER.findall(texts)), name
            compared += 1
    assert compared
