"""The battery: its charge, the highest propeller speed, and the onboard estimate of that."""

from typing import Annotated, Self

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import Scalar, clip_inward
from quadjax.core.sections import ORDERED, Field, Fraction, NonNegative, Positive, Section
from quadjax.core.vectors import Rotors

LOWEST = 0.75  # of the highest command: the lowest estimate, and what is observed as -1
LOW_PASS_S = 0.02  # time constant of the low-pass that the speeds and commands share
FIRST_ERROR_FRACTION = 0.05  # of the highest command: of an episode's first estimate
ADAPTATION_S = 0.2  # time constant of the estimate while all commands are at the limit


class BatteryConfig(Section):
    """Lithium-polymer battery; the defaults are three cells of 1200 mAh (Bebop 1)."""

    voltage: Positive = Field(12.6, description="V, open circuit, full")
    drop: NonNegative = Field(1.5, description="V, of the open-circuit voltage until empty")
    resistance: NonNegative = Field(0.07, description="ohm, with leads and controllers; assumed")
    hover_current: NonNegative = Field(6.5, description="A: 11 minutes of hover")
    capacity: Positive = Field(1.2, description="Ah")
    charge: Annotated[tuple[Fraction, Fraction], ORDERED] = Field(
        (0.6, 1.0), description="lowest, highest at the start"
    )
    rpm_full: Positive | None = Field(
        None, description="rpm at the full voltage; null: 12/11 of rpm_max; assumed"
    )

    def filled(self, rpm_max: float) -> Self:
        """The battery with ``rpm_full``, if None, from the drone's highest command, rpm."""
        return self if self.rpm_full else self.replace(rpm_full=12.0 * rpm_max / 11.0)


class BatteryParams(struct.PyTreeNode):
    """A battery in a drone."""

    strength: jax.Array  # of the sag; 0: none, and no limit
    drop: jax.Array  # fraction of the full voltage lost from full to empty
    resistance: jax.Array  # fraction of the full voltage lost at the hover current
    drain: jax.Array  # fraction of the charge used per second of hover
    rpm_full: jax.Array  # rpm reached at the full voltage
    hover: jax.Array  # rpm


def battery_params(
    config: BatteryConfig, hover_rpm: Scalar, rpm_max: Scalar, strength: float = 1.0
) -> BatteryParams:
    """The numbers of a battery in a drone with these propeller speeds, rpm: hover and highest."""
    numbers = {
        "strength": strength,
        "drop": config.drop / config.voltage,
        "resistance": config.resistance * config.hover_current / config.voltage,
        "drain": config.hover_current / (3600.0 * config.capacity),
        "rpm_full": config.filled(float(rpm_max)).rpm_full,
        "hover": hover_rpm,
    }
    return BatteryParams(**{name: jnp.asarray(x, jnp.float32) for name, x in numbers.items()})


def highest_rpm(p: BatteryParams, rpm: Rotors, charge: jax.Array) -> jax.Array:
    """Highest propeller speed (), rpm, at the battery's voltage; infinite without sag.

    The no-load speed of a motor is proportional to its voltage, which falls with the charge used
    and with the current through the battery's resistance (the linear part of Tremblay and
    Dessaint, "Experimental validation of a battery dynamic model for EV applications", World
    Electric Vehicle Journal 3, 2009). The current is proportional to the rotors' power, the cube of
    their speed, rpm (Leishman, "Principles of helicopter aerodynamics", 2006, chapter 2). The
    ``charge`` () left is 0 to 1.
    """
    left = 1.0 - p.strength * (p.drop * (1.0 - charge) + p.resistance * load(p, rpm))
    return jnp.where(p.strength > 0.0, p.rpm_full * left, jnp.inf)


def load(p: BatteryParams, rpm: Rotors) -> jax.Array:
    """Power () of the rotors over that of hover."""
    fraction = rpm / p.hover
    cube = fraction * fraction * fraction
    return 0.25 * (cube.w1 + cube.w2 + cube.w3 + cube.w4)


def charge_rate(p: BatteryParams, rpm: Rotors) -> jax.Array:
    """Derivative () of the charge, 1/s."""
    return -p.strength * p.drain * load(p, rpm)


class LimitEstimatorParams(struct.PyTreeNode):
    """Numbers of the estimator of the highest speed, at a fixed sample rate."""

    highest: jax.Array  # () rpm, the highest command
    low_pass: jax.Array  # () of a change, in one sample
    lead: jax.Array  # () weight of a speed's difference to its low-pass
    gain: jax.Array  # () of the mean error, in one sample


class LimitEstimatorState(struct.PyTreeNode):
    """Memory of the estimator."""

    speed: Rotors  # low-pass of the measured speeds, rpm
    expected: Rotors  # low-pass of the commands, limited to the estimate, rpm
    limited: Rotors  # low-pass of whether a command is at or above the estimate, 0 to 1
    highest: jax.Array  # () rpm, the estimate


def limit_estimator(highest: Scalar, lag: Scalar, sample_rate: Scalar) -> LimitEstimatorParams:
    """The estimator for motors with a time constant ``lag``, s, and a highest command, rpm.

    The numbers are float32, or float64 where 64-bit types are enabled.
    """
    kind = jnp.result_type(float)
    delay, adaptation = (jnp.asarray(x, kind) for x in (LOW_PASS_S, ADAPTATION_S))
    low_pass = 1.0 - jnp.exp(-1.0 / (delay * sample_rate))
    return LimitEstimatorParams(
        highest=jnp.asarray(highest, kind),
        low_pass=low_pass,
        lead=low_pass * lag * sample_rate,
        gain=0.25 / (adaptation * sample_rate),
    )


def begin(params: LimitEstimatorParams, rpm: Rotors, highest: Scalar) -> LimitEstimatorState:
    """The state before the first sample: steady speeds, rpm, and a first estimate, rpm."""
    zero = jax.tree.map(jnp.zeros_like, rpm)
    first = jnp.clip(highest, LOWEST * params.highest, params.highest)
    return LimitEstimatorState(rpm, rpm, zero, first)


def update(
    params: LimitEstimatorParams, state: LimitEstimatorState, rpm: Rotors, command: Rotors
) -> LimitEstimatorState:
    """One sample of the estimator.

    A motor of first order reaches the command ``rpm + lag rpm'``. Its low-pass is compared with
    that of the command limited to the estimate; where commands have been at the limit, the
    difference corrects the estimate. Commands below the limit tell nothing of it. ``command`` is
    that of the sample before, rpm.
    """

    def towards(past: Rotors, now: Rotors) -> Rotors:
        return past + (now - past) * params.low_pass

    at_limit = jax.tree.map(lambda u: (u >= state.highest).astype(u.dtype), command)
    reachable = jax.tree.map(lambda u: jnp.minimum(u, state.highest), command)
    expected, limited = towards(state.expected, reachable), towards(state.limited, at_limit)
    error = state.speed + (rpm - state.speed) * params.lead - expected
    highest = state.highest + params.gain * sum((error * limited).components())
    highest = jnp.clip(highest, LOWEST * params.highest, params.highest)
    return LimitEstimatorState(towards(state.speed, rpm), expected, limited, highest)


class Battery(struct.PyTreeNode):
    """Numbers of the battery in a race, with the onboard estimator."""

    cells: BatteryParams
    charge: tuple[jax.Array, jax.Array]  # lowest and highest at the start
    estimator: LimitEstimatorParams
    time_step: jax.Array  # s

    def full_power_limit(self, charge: jax.Array) -> jax.Array:
        """The limit (), rpm, with all propellers at the highest command."""
        return highest_rpm(self.cells, Rotors.same(self.estimator.highest), charge)


class BatteryState(struct.PyTreeNode):
    """The battery of one drone."""

    charge: jax.Array  # () left, 0 to 1
    estimate: LimitEstimatorState  # on board


def draw_battery(params: Battery, rpm: Rotors, key: jax.Array) -> BatteryState:
    """A charge of the range, and a first estimate near the limit at full power."""
    fraction, error = jax.random.uniform(key, (2,))
    low, high = params.charge
    charge = low + (high - low) * fraction
    wrong = FIRST_ERROR_FRACTION * params.estimator.highest * (2.0 * error - 1.0)
    first = params.full_power_limit(charge) + wrong
    return BatteryState(charge, begin(params.estimator, rpm, first))


def middle_limit(params: Battery) -> jax.Array:
    """The first estimate (), rpm, of a drone that does not know its charge."""
    low, high = params.charge
    return params.full_power_limit(0.5 * (low + high))


def battery_at_start(params: Battery, rpm: Rotors, state: BatteryState | None) -> BatteryState:
    """The battery of a drone at rest with propeller speeds, rpm; without a state, well charged."""
    first = middle_limit(params) if state is None else state.estimate.highest
    charge = params.charge[1] if state is None else state.charge
    return BatteryState(charge, begin(params.estimator, rpm, first))


def limit_command(params: Battery, state: BatteryState, rpm: Rotors, command: Rotors) -> Rotors:
    """The commands, rpm, that the battery permits at these speeds, rpm."""
    top = jax.lax.stop_gradient(highest_rpm(params.cells, rpm, state.charge))
    return jax.tree.map(lambda u: clip_inward(u, 0.0, top), command)


def advance_battery(
    params: Battery, state: BatteryState, rpm: Rotors, command: Rotors
) -> BatteryState:
    """The battery a step later: its charge, and the estimate, through which no gradient flows.

    Speeds are those after the step, rpm, commands within the nominal range, rpm.
    """
    rpm, command = jax.lax.stop_gradient((rpm, command))
    used = params.time_step * charge_rate(params.cells, rpm)
    charge = jnp.clip(state.charge + used, 0.0, 1.0)
    return BatteryState(charge, update(params.estimator, state.estimate, rpm, command))
