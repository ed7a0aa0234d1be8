"""Observation of the drone's constants.

A policy that observes them is trained over drawn drones and flies all of them. ``quadjax
specialize`` writes the constants of one drone into its first layer.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from quadjax.vehicle.protocol import VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import RaceParams
    from quadjax.race.layout import View

CONSTANTS = "constants"  # name of the field


def numbers(view: "View") -> Sequence[jax.Array]:
    """Every constant of the drone, in the model's order and its units.

    A drone that differs from its model (``vehicle.mismatch``) shows those of the model.
    """
    drawn, known = view.state.constants, view.params.vehicle.constants
    if drawn is None or view.params.mismatch is not None:
        return jax.tree.leaves(known)
    return jax.tree.leaves(drawn)


def bounds(
    model: VehicleModel, params: "RaceParams"
) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """What is observed as -1 and 1: the nominal constants minus and plus the drawn differences.

    Of a population, whose limits are not known, the constants minus and plus their size.
    """
    nominal = jax.tree.leaves(params.vehicle.constants)
    if params.population_width is not None:
        widths = [jnp.abs(x) for x in nominal]
    else:
        parts = jax.tree.leaves(params.randomization)
        widths = [jnp.abs(x) * part for x, part in zip(nominal, parts, strict=True)]
    pairs = list(zip(nominal, widths, strict=True))
    return tuple(x - width for x, width in pairs), tuple(x + width for x, width in pairs)
