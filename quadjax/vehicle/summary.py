"""Quantities derived from the constants of a vehicle model, and warnings of implausible ones."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Command, Motion, State, VehicleModel, VehicleParams

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
    """The summary of a model with constants by name.

    Every combination of lowest and highest commands is simulated from hover (for more than six
    commands each alone), and the largest rates are reported. This works for any model.
    """
    constants = model.constants(**{name: jnp.float32(value) for name, value in values.items()})
    zero = Vec3.zero()
    hover = model.hover(constants, Motion(zero, zero, zero, zero))
    low, high = model.actuator_range(constants)
    acceleration, rates = _fastest(model, VehicleParams(constants), hover)
    return VehicleSummary(
        hover=_numbers(model.actuator_state(hover)),
        lowest=_numbers(low),
        highest=_numbers(high),
        thrust_to_weight=model.thrust_to_weight and float(model.thrust_to_weight(values)),
        angular_acceleration=acceleration,
        body_rates=rates,
        lags={name: values[name] for name in model.lags},
    )


def _numbers(tree: object) -> tuple[float, ...]:
    return tuple(float(x) for x in jax.tree.leaves(tree))


def _fastest(
    model: VehicleModel, params: VehicleParams, hover: State
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The largest angular accelerations and body rates of commands at their limits."""
    low, high = model.command_range(params.constants)
    commands = [
        jax.tree.unflatten(jax.tree.structure(low), ends)
        for ends in _corners(jax.tree.leaves(low), jax.tree.leaves(high))
    ]
    batch = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(each) for each in x]), *commands)
    run = jax.jit(jax.vmap(functools.partial(_simulate, model), in_axes=(None, None, 0)))
    rates = np.abs(np.asarray(run(params, hover, batch)))  # (commands, steps, 3)
    change = np.abs(np.diff(rates, axis=1)) * STEPS / SECONDS
    return _largest(change), _largest(rates)


def _largest(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(x) for x in np.nanmax(values, axis=(0, 1)))


def _corners(low: list, high: list) -> list[tuple]:
    if len(low) <= 6:
        return list(itertools.product(*zip(low, high, strict=True)))
    middle = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
    ends = [(i, end) for i in range(len(low)) for end in (low[i], high[i])]
    return [tuple(end if i == j else x for j, x in enumerate(middle)) for i, end in ends]


def _simulate(
    model: VehicleModel, params: VehicleParams, state: State, command: Command
) -> jax.Array:
    """Body rates (steps, 3), rad/s, under a constant command from ``state``."""

    def step(state: State, _: None) -> tuple[State, jax.Array]:
        change = model.derivative(params, state, command)
        state = jax.tree.map(lambda x, dx: x + dx * (SECONDS / STEPS), state, change)
        return model.wrap(state), jnp.stack(model.rates(state).components())

    return jax.lax.scan(step, state, None, STEPS)[1]


def describe(model: VehicleModel, summary: VehicleSummary) -> str:
    """The summary as lines of text."""
    low, high = np.array(summary.lowest), np.array(summary.highest)
    hover = np.array(summary.hover)
    part = 100.0 * (hover - low) / (high - low)
    limits = f"{low.min():.5g} to {high.max():.5g} {model.actuators.unit}"
    rows = [("hover", f"{_span(hover, '.5g')} of {limits}: {_span(part, '.0f')}% of the range")]
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


def warnings(
    model: VehicleModel, summary: VehicleSummary, values: Mapping[str, float]
) -> list[str]:
    """Implausible values, which are probably in a wrong unit or of a wrong sign."""
    found = []
    ratio = summary.thrust_to_weight
    if ratio is not None and not 1.3 <= ratio <= 20.0:
        found.append(f"thrust-to-weight {ratio:.3g}: typical are 1.3 to 20")
    for name, value in summary.lags.items():
        if not 0.005 <= value <= 0.3:
            found.append(f"{name} {value:g} s: typical are 0.005 to 0.3 s")
    for axis, rate in zip(AXES, summary.body_rates, strict=True):
        least, most = (0.05, 60.0) if axis == "yaw" else (0.5, 150.0)
        if not least <= rate <= most:
            found.append(
                f"{axis}: {rate:.3g} rad/s within {SECONDS:g} s: typical are {least:g} to {most:g}"
            )
    inertia = [values[name] for name in model.groups.get("inertia", ())]
    if len(inertia) == 3 and 2.0 * max(inertia) > 1.001 * sum(inertia):
        found.append("inertia: one moment exceeds the sum of the others, which is impossible")
    damping = model.damping(values) if model.damping else ()
    for name in dict.fromkeys((*model.positive, *model.nonnegative, *damping)):
        if values[name] < 0:
            found.append(f"{name} {values[name]:g}: at least 0 in the frame of the model")
    return found
