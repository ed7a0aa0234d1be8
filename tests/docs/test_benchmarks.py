"""The numbers that scripts of ``benchmarks/`` print are those of the documentation."""

from pathlib import Path

import pytest

from benchmarks import residual_size
from quadjax.core.resources import PRETRAINED

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_size_of_the_residual_of_the_plant():
    name = "standin_residual"
    states = residual_size.states_of(PRETRAINED / "e2e.npz", "e2e")
    sizes = residual_size.sizes(*residual_size.of_residual(PRETRAINED / f"{name}.npz", states))
    row = residual_size.row("`standin`, fitted", sizes)
    assert row in (ROOT / "docs/design/plant.md").read_text(encoding="utf-8").splitlines()
