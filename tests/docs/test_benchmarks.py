"""The numbers that scripts of ``benchmarks/`` print are those of the documentation."""

import runpy
from pathlib import Path

import pytest

from quadjax.core.resources import PRETRAINED

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_size_of_the_residual_of_the_plant():
    script = runpy.run_path(str(ROOT / "benchmarks" / "residual_size.py"))
    name = "standin_residual"
    states = script["states_of"](PRETRAINED / "e2e.npz", "e2e")
    sizes = script["sizes"](*script["of_residual"](PRETRAINED / f"{name}.npz", states))
    row = script["row"]("`standin`, fitted", sizes)
    page = (ROOT / "docs" / "design" / "plant.md").read_text(encoding="utf-8")
    assert row in page.splitlines()
