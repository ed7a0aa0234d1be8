"""Quantities derived from the constants of a vehicle model, and warnings of implausible ones."""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.precision import single_precision
from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Constants, Motion, State, VehicleModel, VehicleParams

AXES = ("roll", "pitch", "yaw")
STEPS, SECONDS = 100, 0.1  # of a simulated command
QUICK = {"xla_backend_optimization_level": 0}  # 0.7 instead of 1.2 s for a program that runs once
TYPICAL_RATES = {"roll": (0.5, 150.0), "pitch": (0.5, 150.0), "yaw": (0.05, 60.0)}  # rad/s


class VehicleSummary(NamedTuple):
    """Quantities derived from the constants of a vehicle."""

    lines: list[str]  # of text that describe them
    warnings: list[str]  # implausible values, which are probably in a wrong unit


@single_precision
def summarize(model: VehicleModel, values: Mapping[str, float]) -> VehicleSummary:
    """The summary of a model with constants by name."""
    c = model.make_constants({name: jnp.float32(value) for name, value in values.items()})
    low, high, hover = (
        np.array(jax.tree.leaves(actuators), np.float64)
        for actuators in (*model.actuator_range(c), model.hover_actuators(c))
    )
    ends = f"{low.min():.5g} to {high.max():.5g} {model.actuators.unit}"
    percent = _span(100.0 * (hover - low) / (high - low), ".0f")
    rows = [("hover", f"{_span(hover, '.5g')} of {ends}: {percent}% of the range")]
    checks: list[tuple[str, float, str, tuple[float, float]]] = []
    ratio = model.thrust_to_weight(model.make_constants(values))
    if ratio is not None:
        rows.append(("thrust-to-weight", f"{ratio:.2f}"))
        checks.append(("thrust-to-weight", float(ratio), "", (1.3, 20.0)))
    lags = {name: values[name] for name in model.lags}
    checks += [(name, value, " s", (0.005, 0.3)) for name, value in lags.items()]
    program = jax.jit(turns, static_argnums=0, compiler_options=QUICK)
    accelerations, rates = program(model, c)
    for axis, change, rate in zip(AXES, accelerations, rates, strict=True):
        rows.append((axis, f"{rate:.3g} rad/s within {SECONDS:g} s, at most {change:.3g} rad/s²"))
        checks.append((axis, float(rate), f" rad/s within {SECONDS:g} s", TYPICAL_RATES[axis]))
    rows += [(name, f"{1e3 * value:.3g} ms") for name, value in lags.items()]
    warnings = [
        f"{name} {value:.3g}{unit}: typical values are {lowest:g} to {highest:g}"
        for name, value, unit, (lowest, highest) in checks
        if not lowest <= value <= highest
    ]
    return VehicleSummary([f"  {name:<18}{text}" for name, text in rows], warnings)


def _span(values: np.ndarray, form: str) -> str:
    ends = dict.fromkeys((f"{values.min():{form}}", f"{values.max():{form}}"))
    return " to ".join(ends)


def turns(model: VehicleModel, constants: Constants) -> tuple[jax.Array, jax.Array]:
    """The largest angular accelerations (3,), rad/s^2, and body rates (3,), rad/s, about x, y, z.

    Every combination of lowest and highest commands is simulated for 0.1 s from a level hover (for
    more than six commands each alone). This works for any model, and for one drone: batch with
    ``jax.vmap``.
    """
    zero, params = Vec3.zero(), VehicleParams(constants)
    hover = model.hover(constants, Motion(zero, zero, zero, zero))
    ends = model.command_range(constants)
    low, high = (jnp.stack(jax.tree.leaves(end)) for end in ends)
    if (size := len(low)) <= 6:
        fractions = jnp.array(list(itertools.product((0.0, 1.0), repeat=size)))
    else:
        fractions = 0.5 + 0.5 * jnp.concatenate([-jnp.eye(size), jnp.eye(size)])

    def rates_under(fraction: jax.Array) -> jax.Array:
        numbers = list(low + (high - low) * fraction)
        command = jax.tree.unflatten(jax.tree.structure(ends[0]), numbers)

        def step(state: State, _: None) -> tuple[State, jax.Array]:
            change = model.derivative(params, state, command)
            state = jax.tree.map(lambda x, dx: x + dx * (SECONDS / STEPS), state, change)
            return state.wrapped(), jnp.stack(state.rates.components())

        return jax.lax.scan(step, hover, None, STEPS)[1]

    rates = jnp.abs(jax.vmap(rates_under)(fractions))  # (commands, steps, 3)
    change = jnp.abs(jnp.diff(rates, axis=1)) * (STEPS / SECONDS)
    return jnp.nanmax(change, axis=(0, 1)), jnp.nanmax(rates, axis=(0, 1))
