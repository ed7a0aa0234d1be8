"""Sections as pytrees: which fields are leaves, and their values."""

import functools
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.sections import Field, Section, Unit
from quadjax.core.traced import as_leaves, register

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


def test_a_section_of_arrays_keeps_arrays():
    """While they are traced, too; they are not validated, but their names are."""
    leaves = as_leaves(Numbers())
    changed = leaves.replace(speed=jnp.float32(-1.0))
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(changed))
    assert changed.speed == -1 and changed.steps is leaves.steps
    faster = jax.jit(lambda numbers, x: numbers.replace(speed=x * numbers.speed))
    assert faster(leaves, 3.0).speed == 6 and leaves.speed == 2
    with pytest.raises(InputError, match="Numbers: unknown key sped; did you mean speed"):
        leaves.replace(sped=1.0)
    with pytest.raises(InputError, match="speed is -1, allowed: greater than 0"):
        Numbers().replace(speed=-1.0)


def test_the_path_of_a_leaf_is_the_name_of_its_field():
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(as_leaves(Numbers()))]
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
    assert names == ["speed", "yaw_deg", "steps", "box.0", "box.1", "weights.a"]
