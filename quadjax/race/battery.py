"""A battery in a race: its charge, the limit of the propeller speeds, and the observed estimate."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import clip_inward
from quadjax.core.vectors import Rotors
from quadjax.vehicle import battery
from quadjax.vehicle.battery import (
    BatteryParams,
    LimitEstimatorParams,
    LimitEstimatorState,
)

FIRST_ERROR = 0.05  # of the highest command: largest error of the first estimate of an episode


@struct.dataclass
class RaceBattery:
    """Numbers of the battery in a race."""

    cells: BatteryParams
    charge: tuple[jax.Array, jax.Array]  # lowest and highest at the start
    estimator: LimitEstimatorParams
    time_step: jax.Array  # s


@struct.dataclass
class BatteryState:
    """The battery of one drone."""

    charge: jax.Array  # () left, 0 to 1
    estimate: LimitEstimatorState  # on board


def drawn(params: RaceBattery, rpm: Rotors, key: jax.Array) -> BatteryState:
    """A charge of the range, and a first estimate near the limit at full power."""
    part, error = jax.random.uniform(key, (2,))
    low, high = params.charge
    charge = low + (high - low) * part
    wrong = FIRST_ERROR * params.estimator.highest * (2.0 * error - 1.0)
    first = full_power_limit(params, charge) + wrong
    return BatteryState(charge, battery.begin(params.estimator, rpm, first))


def full_power_limit(params: RaceBattery, charge: jax.Array) -> jax.Array:
    """The limit (), rpm, with all propellers at the highest command."""
    full = Rotors.same(params.estimator.highest)
    return battery.highest_rpm(params.cells, full, charge)


def middle_limit(params: RaceBattery) -> jax.Array:
    """The first estimate (), rpm, of a drone that does not know its charge."""
    low, high = params.charge
    return full_power_limit(params, 0.5 * (low + high))


def at_start(params: RaceBattery, rpm: Rotors, state: BatteryState | None) -> BatteryState:
    """The battery of a drone at rest with propeller speeds, rpm; without a state, well charged."""
    first = middle_limit(params) if state is None else state.estimate.highest
    charge = params.charge[1] if state is None else state.charge
    return BatteryState(charge, battery.begin(params.estimator, rpm, first))


def limit(params: RaceBattery, state: BatteryState, rpm: Rotors, command: Rotors) -> Rotors:
    """The commands, rpm, that the battery permits at these speeds, rpm."""
    top = jax.lax.stop_gradient(battery.highest_rpm(params.cells, rpm, state.charge))
    return jax.tree.map(lambda u: clip_inward(u, 0.0, top), command)


def advance(params: RaceBattery, state: BatteryState, rpm: Rotors, command: Rotors) -> BatteryState:
    """The battery a step later: its charge, and the estimate, through which no gradient flows.

    Args:
        params: of the battery.
        state: before the step.
        rpm: propeller speeds after the step, rpm.
        command: within the nominal range, rpm.
    """
    rpm, command = jax.lax.stop_gradient((rpm, command))
    used = params.time_step * battery.charge_rate(params.cells, rpm)
    charge = jnp.clip(state.charge + used, 0.0, 1.0)
    return BatteryState(charge, battery.update(params.estimator, state.estimate, rpm, command))
