"""The page on the paper: the modules, configs and tests that its tables name exist."""

import importlib
import re

import pytest

from quadjax.core.resources import CONFIGS
from tests.docs.pages import ROOT

PAGE = ROOT / "docs" / "design" / "paper.md"
MAX_LINES = 150
TEXT = PAGE.read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.splitlines()
    if line.startswith("|") and not re.match(r"\|(---| paper )", line)
]


def codes_of(cell: str) -> list[str]:
    """The names in a cell that are set as code."""
    return re.findall(r"`([^`]+)`", cell)


def test_every_row_has_what_it_is_where_it_is_and_how_it_differs():
    assert len(ROWS) > 30 and len(TEXT.splitlines()) <= MAX_LINES
    for what, here, test, mark in ROWS:
        assert what and here and (mark or here == "no figure"), what
        assert bool(test) == bool(mark), what
        assert re.fullmatch("|F|D[0-9]+", mark), what
    marks = {mark for *_, mark in ROWS if mark.startswith("D")}
    assert marks == set(re.findall(r"^- (D[0-9]+)\.", TEXT, re.M))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_what_a_row_names_exists(row):
    _, here, test, _ = row
    for name in codes_of(here):
        if name.endswith(".yaml"):
            assert (CONFIGS / name).is_file(), name
            continue
        module, *rest = re.split(r"\.(?=[A-Za-z_]+$)", name) if is_object(name) else [name]
        found = importlib.import_module(f"quadjax.{module}")
        assert all(hasattr(found, part) for part in rest), name
    for name in codes_of(test):
        assert (ROOT / "tests" / name).is_file(), name


def is_object(name: str) -> bool:
    """Whether a dotted name is that of an object in a module, by its third part."""
    return name.count(".") == 2
