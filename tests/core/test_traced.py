"""Sections as pytrees: which fields are leaves, and their values."""

import functools
from typing import Annotated

import jax
import numpy as np

from quadjax.core.sections import Field, Section, Unit
from quadjax.core.traced import as_leaves, register, with_leaves

Length = Annotated[float, Field(gt=0)]


@functools.partial(register, whole_numbers=("steps",))
class Numbers(Section):
    """Every kind of field."""

    speed: Length = Field(2.0)
    yaw_deg: Annotated[float | None, Unit("deg")] = Field(90.0)
    steps: int = Field(12)
    box: tuple[Length, Length] | None = Field((1.0, 3.0))
    limit: Length | tuple[Length, Length] | None = Field(None)
    weights: dict[str, Length] = Field({"a": 0.5})
    count: int = Field(4)
    kind: str = Field("square")


def test_floats_are_leaves():
    leaves = as_leaves(Numbers())
    found = [float(leaf) for leaf in jax.tree.leaves(leaves)]
    np.testing.assert_array_equal(found, np.float32([2.0, 90.0, 12, 1.0, 3.0, 0.5]))
    assert leaves.steps.dtype == np.int32 and leaves.speed.dtype == np.float32
    assert (leaves.count, leaves.kind, leaves.limit) == (4, "square", None)


def test_the_rest_is_static():
    doubled = jax.jit(lambda numbers: jax.tree.map(lambda leaf: 2 * leaf, numbers))
    leaves = doubled(as_leaves(Numbers(count=7, yaw_deg=None)))
    assert leaves.count == 7 and leaves.yaw_deg is None and float(leaves.weights["a"]) == 1.0
    same, other = (jax.tree.structure(as_leaves(Numbers(count=count))) for count in (4, 5))
    assert same == jax.tree.structure(as_leaves(Numbers(speed=9.0))) != other
    assert float(as_leaves(Numbers(yaw_deg=0.0)).yaw_deg) == 0.0
    assert float(with_leaves(leaves, speed=np.float32(1e9)).speed) == 1e9  # not validated


def test_the_path_of_a_leaf_is_the_name_of_its_field():
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(as_leaves(Numbers()))]
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
    assert names == ["speed", "yaw_deg", "steps", "box.0", "box.1", "weights.a"]
