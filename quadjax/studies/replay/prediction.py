"""Prediction errors of a vehicle model over windows of a flight log.

From the logged state at the start of each window the model is integrated under the logged commands,
or with its rotors at the logged speeds, and compared with the log.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors
from quadjax.export.race_tables import drone_of, state_sizes
from quadjax.fitting.signals import derivative, low_pass
from quadjax.race.layout import Layout
from quadjax.studies.replay.logged import Logged, commands_of, states_of
from quadjax.vehicle.protocol import State, VehicleModel, VehicleParams
from quadjax.vehicle.racing import RacingConstants, command_of

HORIZONS = (0.1, 0.2, 0.5, 1.0)  # s
STRIDE = 0.1  # s, between the starts of windows
SMOOTH = 16.0  # Hz, of the speeds' derivative
QUANTITIES = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}


@dataclass(frozen=True)
class Prediction:
    """Errors (windows, horizons) by quantity, of the model and of a drone that does not change."""

    drive: str
    horizons: np.ndarray  # (h,) s; the first is one sample
    errors: dict[str, np.ndarray]
    unchanged: dict[str, np.ndarray]


def predict(
    flight: Logged,
    model: VehicleModel,
    params: VehicleParams,
    example: State,
    drive: str | None = None,
    horizons: tuple[float, ...] = HORIZONS,
) -> Prediction:
    """Errors of a model after one sample and after each horizon, over all windows.

    Args:
        flight: the log.
        model: of the drone.
        params: of the model.
        example: a state of the model as shapes.
        drive: commands, speeds, or None: commands if the log has them.
        horizons: s, increasing.

    Raises:
        InputError: the log has not the commands or the speeds, or is shorter than a window.
    """
    given = commands_of(flight, model)
    drive = drive or ("speeds" if given is None else "commands")
    if drive == "speeds":
        given = _commands_of_speeds(flight, model, params, given)
    if given is None:
        wanted = ", ".join(signal.name for signal in model.commands)
        raise InputError(f"{flight.path}: no commands of the model {model.name} ({wanted})")
    steps = np.array([1, *(max(1, round(h / flight.step)) for h in horizons)])
    starts = np.arange(0, len(flight.time) - steps[-1], max(1, round(STRIDE / flight.step)))
    if not len(starts):
        raise InputError(
            f"{flight.path}: {flight.time[-1]:.3g} s of flight, expected more than "
            f"{horizons[-1]:g} s (the longest horizon)"
        )
    layout = Layout(())
    states = states_of(flight, model, state_sizes(layout, model))[starts]
    first = jax.vmap(lambda row: drone_of(layout, model, example, row))(states)
    rows = starts[:, None] + np.arange(steps[-1])
    speeds = flight.actuators[model.actuators.name][rows] if drive == "speeds" else None
    motions = _roll_out(
        model, params, first, np.float32(given[rows]), _float32(speeds), flight.step
    )
    found = [np.asarray(part)[:, steps - 1] for part in motions]
    errors = {name: np.empty((len(starts), len(steps))) for name in QUANTITIES}
    unchanged = {name: np.empty_like(values) for name, values in errors.items()}
    for column, count in enumerate(steps):
        truth = _at(flight, starts + count)
        mine = (*(part[:, column] for part in found[:2]), _rotation(found[2][:, column]))
        _fill(errors, column, (*mine, found[3][:, column]), truth)
        _fill(unchanged, column, _kept(flight, starts, count * flight.step), truth)
    return Prediction(drive, steps * flight.step, errors, unchanged)


Motion = tuple[np.ndarray, np.ndarray, Rotation, np.ndarray]  # position, velocity, attitude, rates


def _at(flight: Logged, rows: np.ndarray) -> Motion:
    return (
        flight.position[rows],
        flight.velocity[rows],
        flight.attitude[rows],
        flight.rates[rows],
    )


def _kept(flight: Logged, rows: np.ndarray, seconds: float) -> Motion:
    """The motion of a drone whose velocity and body rates do not change."""
    position, velocity, attitude, rates = _at(flight, rows)
    turn = Rotation.from_rotvec(rates * seconds)
    return position + velocity * seconds, velocity, attitude * turn, rates


def _fill(errors: dict[str, np.ndarray], column: int, mine: Motion, truth: Motion) -> None:
    turn = np.degrees((mine[2].inv() * truth[2]).magnitude())
    lengths = [np.linalg.norm(mine[i] - truth[i], axis=1) for i in (0, 1, 3)]
    for name, values in zip(QUANTITIES, (*lengths[:2], turn, lengths[2]), strict=True):
        errors[name][:, column] = values


def _rotation(euler: np.ndarray) -> Rotation:
    return Rotation.from_euler("ZYX", np.float64(euler)[:, ::-1])


def _float32(values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else np.asarray(values, np.float32)


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

    return jax.vmap(window)(first, (jnp.asarray(commands), speeds))


def _commands_of_speeds(
    flight: Logged, model: VehicleModel, params: VehicleParams, given: np.ndarray | None
) -> np.ndarray:
    """Commands (n, 4) under which the rotors of a model accelerate as logged."""
    constants = params.constants
    names = [signal.name for signal in model.commands]
    if not flight.speeds_measured or names not in (["rpm"], ["motor_command"]):
        raise InputError(
            f"{flight.path}: no measured rotor speeds for the model {model.name}, expected "
            f"{', '.join(names)}"
        )
    if given is not None:
        return given
    speed = flight.actuators[model.actuators.name]
    cutoff, rate = min(SMOOTH, 0.2 / flight.step), 1.0 / flight.step
    steady = speed + float(constants.tau) * derivative(low_pass(speed, rate, cutoff), rate)
    if names == ["rpm"]:
        return steady
    assert isinstance(constants, RacingConstants)
    return np.asarray(command_of(constants, Rotors.of(jnp.asarray(steady))).array())
