"""A flight log as states and commands of a vehicle model, and the model's predictions of it."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.formats import RPM
from quadjax.fitting.motors import MAP, with_simulated_speeds
from quadjax.fitting.samples import settled
from quadjax.fitting.signals import derivative, low_pass
from quadjax.flights.flight import MOTION, Flight, vehicle_signals
from quadjax.vehicle import estimator
from quadjax.vehicle.estimator import EstimatorState
from quadjax.vehicle.protocol import Measurement, Motion, State, VehicleModel, VehicleParams
from quadjax.vehicle.racing import RacingConstants, command_of

HORIZONS = (0.1, 0.2, 0.5, 1.0)  # s, of predictions
STRIDE = 0.1  # s, between the starts of windows
SMOOTH = 16.0  # Hz, of the speeds' derivative
DISTURBANCES = ("moment_ext", "force_ext")  # fields of the state that no log has
COLUMNS = {  # signals of a log with the commands of a model, by the name of the command
    "rpm": "command",
    "motor_command": "motor_command",
    "body_rates": "rate_command",
    "thrust": "thrust_command",
}
Arrays = dict[str, np.ndarray]


def vehicle_flight(log: Flight, model: VehicleModel, params: VehicleParams) -> Flight:
    """The flying part of a log, with the signals "actuators" and "command" of a model, if known.

    Without measured rotor speeds they are those that the motor commands give; the flight then
    starts later. ``source`` has "measured", whether the speeds are.

    Args:
        log: with position and attitude.
        model: of the drone; its motors give the speeds that the log lacks.
        params: of the model.

    Raises:
        InputError: no position or attitude, or no sample in flight.
    """
    path, measured = log.source["path"], "actuators" in log.signals
    if not np.isfinite([log["position"], log["attitude"]]).all():
        raise InputError(f"{path}: replay needs columns for position and attitude")
    if not measured:
        log = log.with_signals(flying=settled(log)[:, None])
        if all(hasattr(params.constants, name) for name in MAP):
            motors = np.array([float(getattr(params.constants, name)) for name in MAP])
            log = with_simulated_speeds(log, motors)
    flight = log.airborne()
    if len(flight.time) < 2:
        raise InputError(f"{path}: no sample in flight (logs.columns.mode)")
    states = {"thrust": -flight["specific_force"][:, 2:]}
    if "actuators" in flight.signals:
        states |= {"rpm": flight["actuators"], "rotor_speed": flight["actuators"] / RPM}
    names = [COLUMNS.get(signal.name, "") for signal in model.commands]
    commands = [flight[name] for name in names if name in flight.signals]
    nothing = np.zeros((len(flight.time), 0))
    command = np.concatenate(commands, axis=1) if len(commands) == len(names) else nothing
    of_model = vehicle_signals(model, command, states.get(model.actuators.name, nothing))
    signals = {name: value for name, value in flight.signals.items() if name not in of_model}
    signals |= {name: value for name, value in of_model.items() if value.values.size}
    return flight.replace(signals=signals, source=flight.source | {"measured": measured})


def disturbances_of(
    flight: Flight, model: VehicleModel, params: VehicleParams
) -> dict[str, np.ndarray]:
    """External moment, N m, and force, m/s^2, (n, 3) body, by the onboard estimator.

    Empty for a model without an estimator, or a log without rotor speeds.
    """
    if not model.can_be_disturbed or "actuators" not in flight.signals:
        return {}
    filters = estimator.estimator_params(model, params, 1.0 / flight.step)
    velocity = flight.rotation.inv().apply(flight["velocity"])
    vectors = (flight["rates"], flight["specific_force"], velocity)
    gyro, force, velocity = (Vec3(*jnp.asarray(x.T, jnp.float32)) for x in vectors)
    speeds = Rotors(*jnp.asarray(flight["actuators"].T, jnp.float32))
    samples = Measurement(gyro, force, speeds, velocity)

    def step(state: EstimatorState, sample: Measurement) -> tuple[EstimatorState, list[jax.Array]]:
        state, *estimates = estimator.update(filters, state, sample)
        return state, [estimate.array() for estimate in estimates]

    start = estimator.init(filters, jax.tree.map(lambda x: x[0], samples))
    _, estimates = jax.jit(functools.partial(jax.lax.scan, step))(start, samples)
    return {name: np.asarray(x) for name, x in zip(DISTURBANCES, estimates, strict=True)}


def states_of(
    flight: Flight, model: VehicleModel, sizes: Mapping[str, int], more: Mapping[str, np.ndarray]
) -> np.ndarray:
    """States (n, k) float32 of a model in the order of ``sizes``, names and sizes of the fields.

    ``more`` has fields that the log does not have; without it disturbances are zero.

    Raises:
        InputError: a field that the log does not have.
    """
    values = {name: np.zeros((len(flight.time), 3)) for name in DISTURBANCES}
    values |= {name: flight[name] for name in ("position", "velocity", "rates")}
    values |= {"euler": flight["attitude"]}
    values |= {"quaternion": flight.rotation.as_quat()[:, [3, 0, 1, 2]], **more}
    if "actuators" in flight.signals:
        values[model.actuators.name] = flight["actuators"]
    for name, size in sizes.items():
        if name not in values or values[name].shape[1] != size:
            raise InputError(
                f"{flight.source['path']}: the model {model.name} has {name} ({size}), which no "
                "column of the log gives"
            )
    return np.concatenate([values[name] for name in sizes], axis=1).astype(np.float32)


def predict(
    flight: Flight, model: VehicleModel, params: VehicleParams, drive: str | None = None
) -> tuple[dict[str, Any], dict[str, Arrays]]:
    """Errors of predictions over windows of a flight: numbers as JSON takes them, and arrays.

    Errors (windows, horizons) by quantity: of the model ("rms_error"), and of a drone that keeps
    its velocity and body rates ("rms_unchanged"). ``drive`` as of ``quadjax.replay.replay``.

    Raises:
        InputError: nothing to drive the model with, or a flight shorter than a window.
    """
    step, drive = flight.step, drive or ("commands" if "command" in flight.signals else "speeds")
    commands = _driving_commands(flight, model, params, drive)
    steps = np.array([1, *(max(1, round(horizon / step)) for horizon in HORIZONS)])
    starts = np.arange(0, len(flight.time) - steps[-1], max(1, round(STRIDE / step)))
    if not len(starts):
        raise InputError(
            f"{flight.source['path']}: {flight.time[-1]:.3g} s of flight, expected more than "
            f"{HORIZONS[-1]:g} s (the longest horizon)"
        )
    sizes = {"position": 3, "velocity": 3, "euler": 3, "rates": 3}
    sizes[model.actuators.name] = model.actuators.size
    first = states_of(flight, model, sizes, {})[starts]
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
        state = model.hold(state.wrapped(), command)
        vectors = (state.position, state.velocity, state.angles, state.rates)
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
    change = derivative(low_pass(speed, rate, min(SMOOTH, 0.2 * rate)), rate)
    steady = speed + float(constants.tau) * change
    if not isinstance(constants, RacingConstants):
        return steady
    return np.asarray(command_of(constants, Rotors.of(jnp.asarray(steady))).array())
