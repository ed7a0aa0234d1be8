"""The numbers of several drones in one simulation."""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError

Tree = TypeVar("Tree")


def shared_or_stacked(drones: Sequence[Tree], runs: int) -> tuple[Tree, tuple[bool, ...]]:
    """The numbers of several drones as one tree, and which of its leaves differ among them.

    A leaf that differs becomes (.., runs), the drones' numbers in turn.

    Raises:
        InputError: drones that differ in more than numbers.
    """
    leaves, structures = zip(*map(jax.tree.flatten, drones), strict=True)
    if any(structure != structures[0] for structure in structures):
        raise InputError(
            "population: drones differ in the delay's samples or in which effects are on"
        )
    result, differ = [], []
    for values in zip(*leaves, strict=True):
        differs = any(not np.array_equal(value, values[0]) for value in values)
        turns = [values[run % len(values)] for run in range(runs)]
        result.append(jnp.stack(turns, axis=-1) if differs else values[0])
        differ.append(differs)
    return jax.tree.unflatten(structures[0], result), tuple(differ)
