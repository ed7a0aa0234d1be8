"""Quantities derived from the constants of a vehicle model, and warnings of implausible ones."""

import dataclasses
import itertools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Command, Constants, Motion, State, VehicleModel, VehicleParams

AXES = ("roll", "pitch", "yaw")
STEPS = 100  # of a simulated command
SECONDS = 0.1  # duration of that command


@dataclasses.dataclass(frozen=True)
class VehicleSummary:
    """Quantities derived from the constants of a vehicle.

    Attributes:
        hover: state of the actuators in hover, in units of the model.
        lowest, highest: their range.
        thrust_to_weight: at the highest command; None if the model does not define it.
        angular_acceleration: largest about x, y and z in hover, rad/s^2.
        body_rates: largest about x, y and z that 0.1 s of one command reach from hover, rad/s.
        lags: time constants by name, s.
    """

    hover: tuple[float, ...]
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    thrust_to_weight: float | None
    angular_acceleration: tuple[float, ...]
    body_rates: tuple[float, ...]
    lags: dict[str, float]


def summarize(model: VehicleModel, values: Mapping[str, float]) -> VehicleSummary:
    """The summary of a model with constants by name."""
    constants = model.make_constants({name: jnp.float32(value) for name, value in values.items()})
    zero = Vec3.zero()
    hover = model.hover(constants, Motion(zero, zero, zero, zero))
    low, high = model.actuator_range(constants)
    ratio = model.thrust_to_weight(model.make_constants(values))
    accelerations, rates = jax.jit(turns, static_argnums=0)(model, constants)
    return VehicleSummary(
        hover=_numbers(hover.actuators),
        lowest=_numbers(low),
        highest=_numbers(high),
        thrust_to_weight=None if ratio is None else float(ratio),
        angular_acceleration=_numbers(list(accelerations)),
        body_rates=_numbers(list(rates)),
        lags={name: values[name] for name in model.lags},
    )


def _numbers(tree: object) -> tuple[float, ...]:
    return tuple(float(x) for x in jax.tree.leaves(tree))


def turns(model: VehicleModel, constants: Constants) -> tuple[jax.Array, jax.Array]:
    """The largest angular accelerations (3,), rad/s^2, and body rates (3,), rad/s, about x, y, z.

    Every combination of lowest and highest commands is simulated for 0.1 s from a level hover (for
    more than six commands each alone). This works for any model, and for one drone: batch with
    ``jax.vmap``.
    """
    zero = Vec3.zero()
    hover = model.hover(constants, Motion(zero, zero, zero, zero))
    low, high = (jnp.stack(jax.tree.leaves(end)) for end in model.command_range(constants))
    structure = jax.tree.structure(model.command_range(constants)[0])

    def rates_under(fraction: jax.Array) -> jax.Array:
        held = jax.tree.unflatten(structure, list(low + (high - low) * fraction))
        return _simulate(model, VehicleParams(constants), hover, held)

    rates = jnp.abs(jax.vmap(rates_under)(_corners(len(low))))  # (commands, steps, 3)
    change = jnp.abs(jnp.diff(rates, axis=1)) * (STEPS / SECONDS)
    return jnp.nanmax(change, axis=(0, 1)), jnp.nanmax(rates, axis=(0, 1))


def _corners(size: int) -> jax.Array:
    """Commands (n, size) at their limits, as fractions of their range."""
    if size <= 6:
        return jnp.array(list(itertools.product((0.0, 1.0), repeat=size)))
    return 0.5 + 0.5 * jnp.concatenate([-jnp.eye(size), jnp.eye(size)])


def _simulate(
    model: VehicleModel, params: VehicleParams, state: State, command: Command
) -> jax.Array:
    """Body rates (steps, 3), rad/s, under a constant command from ``state``."""

    def step(state: State, _: None) -> tuple[State, jax.Array]:
        change = model.derivative(params, state, command)
        state = jax.tree.map(lambda x, dx: x + dx * (SECONDS / STEPS), state, change)
        return state.wrapped(), jnp.stack(state.rates.components())

    return jax.lax.scan(step, state, None, STEPS)[1]


def describe(model: VehicleModel, summary: VehicleSummary) -> str:
    """The summary as lines of text."""
    low, high = np.array(summary.lowest), np.array(summary.highest)
    hover = np.array(summary.hover)
    percent = 100.0 * (hover - low) / (high - low)
    limits = f"{low.min():.5g} to {high.max():.5g} {model.actuators.unit}"
    rows = [("hover", f"{_span(hover, '.5g')} of {limits}: {_span(percent, '.0f')}% of the range")]
    if summary.thrust_to_weight is not None:
        rows.append(("thrust-to-weight", f"{summary.thrust_to_weight:.2f}"))
    for axis, change, rate in zip(
        AXES, summary.angular_acceleration, summary.body_rates, strict=True
    ):
        rows.append((axis, f"{rate:.3g} rad/s within {SECONDS:g} s, at most {change:.3g} rad/s²"))
    rows += [(name, f"{1e3 * value:.3g} ms") for name, value in summary.lags.items()]
    return "\n".join(f"  {name:<18}{text}" for name, text in rows)


def _span(values: np.ndarray, form: str) -> str:
    ends = dict.fromkeys((f"{values.min():{form}}", f"{values.max():{form}}"))
    return " to ".join(ends)


def warnings(summary: VehicleSummary) -> list[str]:
    """Implausible values, which are probably in a wrong unit."""
    messages = []
    ratio = summary.thrust_to_weight
    if ratio is not None and not 1.3 <= ratio <= 20.0:
        messages.append(f"thrust-to-weight {ratio:.3g}: typical values are 1.3 to 20")
    for name, value in summary.lags.items():
        if not 0.005 <= value <= 0.3:
            messages.append(f"{name} {value:g} s: typical values are 0.005 to 0.3 s")
    for axis, rate in zip(AXES, summary.body_rates, strict=True):
        lowest, highest = (0.05, 60.0) if axis == "yaw" else (0.5, 150.0)
        if not lowest <= rate <= highest:
            typical = f"typical values are {lowest:g} to {highest:g}"
            messages.append(f"{axis}: {rate:.3g} rad/s within {SECONDS:g} s: {typical}")
    return messages
