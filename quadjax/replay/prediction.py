"""Prediction errors of a vehicle model over windows of a flight log.

From the logged state at the start of each window the model is integrated under the logged commands,
or with its rotors at the logged speeds, and compared with the log.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors
from quadjax.export.race_tables import drone_of, state_sizes
from quadjax.fitting.signals import derivative, low_pass
from quadjax.flights.flight import Flight
from quadjax.race.layout import Layout
from quadjax.replay.states import states_of, step_of
from quadjax.vehicle.protocol import State, VehicleModel, VehicleParams
from quadjax.vehicle.racing import RacingConstants, command_of

HORIZONS = (0.1, 0.2, 0.5, 1.0)  # s
STRIDE = 0.1  # s, between the starts of windows
SMOOTH = 16.0  # Hz, of the speeds' derivative
QUANTITIES = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Errors (windows, horizons) by quantity, of a model and of a drone that does not change.

    Attributes:
        drive: "commands" or "speeds".
        horizons: (h,) s; the first is one sample.
        errors: of the model.
        unchanged: of a drone with constant velocity and body rates.
    """

    drive: str
    horizons: np.ndarray
    errors: dict[str, np.ndarray]
    unchanged: dict[str, np.ndarray]


def predict(
    flight: Flight,
    model: VehicleModel,
    params: VehicleParams,
    example: State,
    drive: str | None = None,
    horizons: tuple[float, ...] = HORIZONS,
) -> Prediction:
    """Errors of a model after one sample and after each horizon, over all windows.

    Args:
        flight: of ``vehicle_flight``.
        model: of the drone.
        params: of the model.
        example: a state of the model as shapes.
        drive: commands, speeds, or None: commands if the log has them.
        horizons: s, increasing.

    Raises:
        InputError: the log has not the commands or the speeds, or is shorter than a window.
    """
    step, path = step_of(flight), flight.source["path"]
    drive = drive or ("commands" if "command" in flight.signals else "speeds")
    if drive == "speeds":
        commands = _commands_of_speeds(flight, model, params)
    elif "command" in flight.signals:
        commands = flight["command"]
    else:
        names = ", ".join(signal.name for signal in model.commands)
        raise InputError(f"{path}: no commands of the model {model.name} ({names})")
    steps = np.array([1, *(max(1, round(h / step)) for h in horizons)])
    starts = np.arange(0, len(flight.time) - steps[-1], max(1, round(STRIDE / step)))
    if not len(starts):
        raise InputError(
            f"{path}: {flight.time[-1]:.3g} s of flight, expected more than {horizons[-1]:g} s "
            "(the longest horizon)"
        )
    layout = Layout(())
    states = states_of(flight, model, state_sizes(layout, model), {})[starts]
    first = jax.vmap(lambda row: drone_of(layout, model, example, row))(states)
    rows = starts[:, None] + np.arange(steps[-1])
    speeds = np.float32(flight["actuators"][rows]) if drive == "speeds" else None
    motions = _roll_out(model, params, first, np.float32(commands[rows]), speeds, step)
    found = [np.asarray(part, np.float64)[:, steps - 1] for part in motions]
    place, velocity, turn, rates = _motion(flight, starts)
    errors, unchanged = [], []
    for column, count in enumerate(steps):
        truth, seconds = _motion(flight, starts + count), count * step
        position, speed, euler, turning = (part[:, column] for part in found)
        attitude = Rotation.from_euler("ZYX", euler[:, ::-1])
        errors.append(_errors((position, speed, attitude, turning), truth))
        turned = turn * Rotation.from_rotvec(rates * seconds)
        unchanged.append(_errors((place + velocity * seconds, velocity, turned, rates), truth))
    of_model, of_none = (np.stack(each, axis=2) for each in (errors, unchanged))
    tables = (dict(zip(QUANTITIES, each, strict=True)) for each in (of_model, of_none))
    return Prediction(drive, steps * step, *tables)


Motion = tuple[np.ndarray, np.ndarray, Rotation, np.ndarray]  # position, velocity, attitude, rates


def _motion(flight: Flight, rows: np.ndarray) -> Motion:
    position, velocity, rates = (flight[name][rows] for name in ("position", "velocity", "rates"))
    return position, velocity, flight.rotation[rows], rates


def _errors(motion: Motion, truth: Motion) -> np.ndarray:
    """Errors (quantities, windows), in the order of ``QUANTITIES``."""
    turn = np.degrees((motion[2].inv() * truth[2]).magnitude())
    position, velocity, rates = (np.linalg.norm(motion[i] - truth[i], axis=1) for i in (0, 1, 3))
    return np.stack([position, velocity, turn, rates])


@functools.partial(jax.jit, static_argnames="model")
def _roll_out(
    model: VehicleModel,
    params: VehicleParams,
    first: State,
    commands: np.ndarray,
    speeds: np.ndarray | None,
    dt: float,
) -> tuple[jax.Array, ...]:
    """Position, velocity, Euler angles and rates (windows, steps, 3) after each step.

    Args:
        model: of the drone.
        params: of the model.
        first: states at the start of the windows.
        commands: (windows, steps, k), each held for dt s.
        speeds: (windows, steps, 4) of the rotors at the start of each step, or None.
        dt: s.
    """
    structure = jax.tree.structure(model.command_range(params.constants)[0])

    def step(
        state: State, given: tuple[jax.Array, jax.Array | None]
    ) -> tuple[State, tuple[jax.Array, ...]]:
        numbers, speed = given
        command = jax.tree.unflatten(structure, [numbers[i] for i in range(numbers.shape[0])])
        state = state if speed is None else state.replace(actuators=Rotors.of(speed))
        state = rk4_step(lambda s: model.derivative(params, s, command), state, dt)
        state = model.hold(state.wrapped(), command)
        vectors = (state.position, state.velocity, state.angles, state.rates)
        return state, tuple(vector.array() for vector in vectors)

    def window(start: State, inputs: tuple[jax.Array, jax.Array | None]) -> tuple[jax.Array, ...]:
        return jax.lax.scan(step, start, inputs)[1]

    turning = None if speeds is None else jnp.asarray(speeds)
    return jax.vmap(window)(first, (jnp.asarray(commands), turning))


def _commands_of_speeds(flight: Flight, model: VehicleModel, params: VehicleParams) -> np.ndarray:
    """Commands (n, 4) under which the rotors of a model accelerate as logged."""
    constants, step = params.constants, step_of(flight)
    names = [signal.name for signal in model.commands]
    if not flight.source["measured"] or names not in (["rpm"], ["motor_command"]):
        raise InputError(
            f"{flight.source['path']}: no measured rotor speeds for the model {model.name}, "
            f"expected {', '.join(names)}"
        )
    if "command" in flight.signals:
        return flight["command"]
    speed = flight["actuators"]
    change = derivative(low_pass(speed, 1.0 / step, min(SMOOTH, 0.2 / step)), 1.0 / step)
    steady = speed + float(constants.tau) * change
    if names == ["rpm"]:
        return steady
    assert isinstance(constants, RacingConstants)
    return np.asarray(command_of(constants, Rotors.of(jnp.asarray(steady))).array())
