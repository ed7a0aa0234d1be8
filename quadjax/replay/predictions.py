"""Predictions of a vehicle model over windows of a flight log, and their errors."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.signals import derivative, low_pass
from quadjax.flights.flight import MOTION, Flight
from quadjax.replay.log_states import stack_states
from quadjax.vehicle.protocol import Motion, State, VehicleModel, VehicleParams
from quadjax.vehicle.racing import RacingConstants, command_of

HORIZONS_S = (0.1, 0.2, 0.5, 1.0)  # of predictions
STRIDE_S = 0.1  # between the starts of windows
SMOOTH_HZ = 16.0  # of the speeds' derivative
Arrays = dict[str, np.ndarray]


def predict(
    flight: Flight, model: VehicleModel, params: VehicleParams, drive: str | None = None
) -> tuple[dict[str, Any], dict[str, Arrays]]:
    """Errors of predictions over windows of a flight: numbers as JSON takes them, and arrays.

    Errors (windows, horizons) by quantity: of the model ("rms_error"), and of a drone that keeps
    its velocity and body rates ("rms_unchanged"). ``drive`` as of ``quadjax.replay.replay.replay``.

    Raises:
        InputError: nothing to drive the model with, or a flight shorter than a window.
    """
    step, drive = flight.step, drive or ("commands" if "command" in flight.signals else "speeds")
    commands = _driving_commands(flight, model, params, drive)
    steps = np.array([1, *(max(1, round(horizon / step)) for horizon in HORIZONS_S)])
    starts = np.arange(0, len(flight.time) - steps[-1], max(1, round(STRIDE_S / step)))
    if not len(starts):
        raise InputError(
            f"{flight.source['path']}: {flight.time[-1]:.3g} s of flight, expected more than "
            f"{HORIZONS_S[-1]:g} s (the longest horizon)"
        )
    sizes = {"position": 3, "velocity": 3, "euler": 3, "rates": 3}
    sizes[model.actuators.name] = model.actuators.size
    first = stack_states(flight, model, sizes, {})[starts]
    rows = starts[:, None] + np.arange(steps[-1])
    speeds = np.float32(flight["actuators"][rows]) if drive == "speeds" else None
    modeled = _roll_out(model, params, first, np.float32(commands[rows]), speeds, step)
    ends, begin = (starts[:, None] + steps).ravel(), np.repeat(starts, len(steps))

    def errors(motion: Arrays, attitude: Rotation) -> Arrays:
        by_name = {k: np.linalg.norm(x - flight[k][ends], axis=1) for k, x in motion.items()}
        by_name["attitude"] = np.degrees((attitude.inv() * flight.rotation[ends]).magnitude())
        return {name: by_name[name].reshape(-1, len(steps)) for name in MOTION}

    ahead = np.asarray(modeled, np.float64)[:, :, steps - 1].reshape(len(MOTION), -1, 3)
    motion, kept = dict(zip(MOTION, ahead, strict=True)), {k: flight[k][begin] for k in MOTION}
    seconds = np.tile(steps * step, len(starts))[:, None]
    turned = flight.rotation[begin] * Rotation.from_rotvec(kept["rates"] * seconds)
    kept["position"] = kept["position"] + kept["velocity"] * seconds
    euler = Rotation.from_euler("ZYX", motion["attitude"][:, ::-1])
    tables = {"rms_error": errors(motion, euler), "rms_unchanged": errors(kept, turned)}
    numbers = {"model": model.name, "drive": drive, "windows": len(starts)}
    numbers["horizons"] = (steps * step).tolist()
    for key, table in tables.items():
        numbers[key] = {name: np.sqrt((x**2).mean(axis=0)).tolist() for name, x in table.items()}
    return numbers, tables


@functools.partial(jax.jit, static_argnames="model")
def _roll_out(
    model: VehicleModel,
    params: VehicleParams,
    first: jax.Array,
    commands: jax.Array,
    speeds: jax.Array | None,
    dt: float,
) -> jax.Array:
    """Motions (quantities, windows, steps, 3) after each step of dt s, from states (windows, k).

    Commands (windows, steps, k) are held for a step; speeds (windows, steps, 4), rad/s or rpm, are
    those of the rotors at its start.
    """
    structure = jax.tree.structure(model.command_range(params.constants)[0])

    def step(state: State, inputs: tuple[jax.Array, jax.Array | None]) -> tuple[State, jax.Array]:
        numbers, speed = inputs
        command = jax.tree.unflatten(structure, list(numbers))
        state = state if speed is None else state.replace(actuators=Rotors.of(speed))
        state = rk4_step(lambda s: model.derivative(params, s, command), state, dt)
        state = state.wrapped()
        vectors = (state.position, state.velocity, state.euler, state.rates)
        return state, jnp.stack([vector.array() for vector in vectors])

    def window(row: jax.Array, commands: jax.Array, speeds: jax.Array | None) -> jax.Array:
        motion = Motion(*(Vec3(*row[i : i + 3]) for i in range(0, 12, 3)))
        hover = model.hover(params.constants, motion)
        actuators = jax.tree.unflatten(jax.tree.structure(hover.actuators), list(row[12:]))
        return jax.lax.scan(step, hover.replace(actuators=actuators), (commands, speeds))[1]

    return jnp.moveaxis(jax.vmap(window)(first, commands, speeds), 2, 0)


def _driving_commands(
    flight: Flight, model: VehicleModel, params: VehicleParams, drive: str
) -> np.ndarray:
    """Commands (n, k): the logged ones, or those under which rotors accelerate as logged."""
    names, path = ", ".join(signal.name for signal in model.commands), flight.source["path"]
    measured = flight.source["measured"] and names in ("rpm", "motor_command")
    if drive == "speeds" and not measured:
        missing = f"measured rotor speeds for the model {model.name}, expected {names}"
        raise InputError(f"{path}: no {missing}")
    if "command" in flight.signals:
        return flight["command"]
    if drive == "commands":
        raise InputError(f"{path}: no commands of the model {model.name} ({names})")
    speed, rate, constants = flight["actuators"], 1.0 / flight.step, params.constants
    change = derivative(low_pass(speed, rate, min(SMOOTH_HZ, 0.2 * rate)), rate)
    steady = speed + float(constants.tau) * change
    if not isinstance(constants, RacingConstants):
        return steady
    return np.asarray(command_of(constants, Rotors.of(jnp.asarray(steady))).array())
