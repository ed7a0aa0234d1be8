"""The numbers that scripts of ``benchmarks/`` compute are those of their stored rows."""

import pytest

from benchmarks import residual_size, rows
from quadjax.core.resources import PRETRAINED


@pytest.mark.slow
def test_size_of_the_residual_of_the_plant():
    name = "standin_residual"
    file, states = f"{name}.npz", residual_size.states_of()
    sizes = residual_size.sizes(*residual_size.of_residual(PRETRAINED / file, states))
    (stored,) = (row for row in rows.read("size") if row["name"] == name)
    assert stored | residual_size.row(name, file, sizes) == stored
