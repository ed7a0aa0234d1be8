"""The page on the paper: the modules, configs and tests that its tables name exist."""

import importlib
import re

from quadjax.core.resources import CONFIGS
from tests.docs.pages import ROOT

MAX_LINES = 165
TEXT = (ROOT / "docs" / "design" / "paper.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.splitlines()
    if line.startswith("|") and not re.match(r"\|(---| paper | outlook )", line)
]
CODE = re.compile(r"`([^`]+)`")
NUMBER = re.compile(r"^\(\d\)")  # of an equation


def test_every_row_has_what_it_is_where_it_is_and_how_it_differs():
    assert len(ROWS) > 30 and len(TEXT.splitlines()) <= MAX_LINES
    for what, here, test, mark in ROWS:
        assert what and here and (mark or what.startswith("Fig. ")), what
        assert bool(test) == bool(mark), what
        assert re.fullmatch("|F|D[0-9]+", mark), what
    marks = [mark for *_, mark in ROWS if mark.startswith("D")]
    notes = re.findall(r"^- (D[0-9]+)\.", TEXT, re.M)
    assert list(dict.fromkeys(marks)) == notes == [f"D{n + 1}" for n in range(len(notes))]
    assert {"(1)", "(2)", "(3)"} == {found for row in ROWS for found in NUMBER.findall(row[0])}


def test_what_a_row_names_exists():
    for _, here, test, _ in ROWS:
        for name in CODE.findall(here):
            if name.endswith(".yaml"):
                assert (CONFIGS / name).is_file(), name
                continue
            package, module, *rest = name.split(".")
            found = importlib.import_module(f"quadjax.{package}.{module}")
            for part in rest:
                assert hasattr(found, part), name
                found = getattr(found, part)
        for name in CODE.findall(test):
            assert (ROOT / "tests" / name).is_file(), name
