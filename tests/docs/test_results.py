"""The page of results and the README have the numbers of benchmarks/results.json."""

import json
import re
import runpy

from tests.docs.pages import ROOT

SCRIPT = runpy.run_path(str(ROOT / "benchmarks" / "results.py"))
DATA = json.loads(SCRIPT["FILE"].read_text(encoding="utf-8"))
NUMBER = re.compile(r"\d+(?:\.\d+)?")
PAGE = SCRIPT["PAGE"].read_text(encoding="utf-8")


def test_the_page_has_the_tables_of_the_file():
    assert SCRIPT["render"](DATA, PAGE) == PAGE, "run: make results"
    tables = {*SCRIPT["TABLES"], "body", "measured"}
    assert set(re.findall(r"<!-- results: (\w+) -->", PAGE)) == tables
    changed = json.loads(json.dumps(DATA))
    changed["presets"][0]["total"]["mean"][2] -= 0.01
    assert SCRIPT["render"](changed, PAGE) != PAGE


def test_a_row_has_a_number_for_each_seed():
    for row in (row for table in SCRIPT["TABLES"].values() for row in DATA[table[0]]):
        columns = [*row["total"].values(), *row["finished"].values()]
        assert {len(column) for column in columns} == {len(row.get("seeds", [0]))}, row["name"]
        assert all(0 <= n <= row["flights"] for c in row["finished"].values() for n in c)


def test_the_readme_has_numbers_of_the_file():
    """The first words of a row of results in the README are the name of a row of the file."""
    rows = {row["name"]: row for row in DATA["presets"]}
    titles = "|".join(SCRIPT["TABLES"][name][1] for name in ("presets", "training")).split("|")
    compared = 0
    for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines():
        name, _, cells = line.removeprefix("| `").partition("`")
        if line.startswith("| `") and name in rows:
            texts = " ".join(SCRIPT["COLUMNS"][title](rows[name]) for title in titles)
            assert set(NUMBER.findall(cells)) <= set(NUMBER.findall(texts)), name
            compared += 1
    assert compared
