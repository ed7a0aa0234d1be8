"""The signals of a flight log as the states and commands of a vehicle model."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.motor_map import NAMES, RPM, settled, with_simulated_speeds
from quadjax.vehicle.estimator import EstimatorState, estimator_params, init, update
from quadjax.vehicle.protocol import Constants, Measurement, VehicleModel, VehicleParams

Signals = dict[str, np.ndarray]
DISTURBANCES = ("moment_ext", "force_ext")  # fields of the state that no log has


@dataclasses.dataclass(frozen=True)
class Logged:
    """The flying part of a log, n samples evenly spaced; world NED, body FRD."""

    name: str
    path: str
    time: np.ndarray  # (n,) s, from 0
    position: np.ndarray  # (n, 3) m
    velocity: np.ndarray  # (n, 3) m/s, world
    attitude: Rotation  # n, body to world
    rates: np.ndarray  # (n, 3) rad/s
    specific_force: np.ndarray  # (n, 3) m/s^2, body
    actuators: Signals  # (n, k) by the name of ``VehicleModel.actuators``, where they are known
    commands: Signals  # (n, k) by the name of ``VehicleModel.commands``
    speeds_measured: bool

    @property
    def step(self) -> float:
        """Time between samples, s."""
        return float(self.time[-1]) / (len(self.time) - 1)


def logged(log: FlightLog, model: VehicleModel, params: VehicleParams) -> Logged:
    """The signals of a log, from its first to its last sample in flight.

    Args:
        log: with position and attitude.
        model: of the drone; its motors give the speeds that the log lacks.
        params: of the model.

    Raises:
        InputError: no position or attitude, or no sample in flight.
    """
    if log.position is None or log.attitude is None:
        raise InputError(f"{log.path}: replay needs columns for position and attitude")
    log, known = _with_speeds(log, params.constants)
    flying = np.flatnonzero(log.flying)
    if flying.size < 2:
        raise InputError(f"{log.path}: no sample in flight (logs.columns.mode)")
    part = slice(int(flying[0]), int(flying[-1]) + 1)
    attitude = log.attitude[part]
    commands = {
        "rpm": log.rpm_command,
        "motor_command": log.motor_command,
        "body_rates": log.rate_command,
        "thrust": None if log.thrust_command is None else log.thrust_command[:, None],
    }
    speeds = {"rpm": log.rpm[part], "rotor_speed": log.rpm[part] / RPM}
    return Logged(
        log.name,
        log.path,
        log.time[part] - log.time[part][0],
        log.position[part],
        attitude.apply(log.body_velocity[part]),
        attitude,
        log.rates[part],
        log.specific_force[part],
        {"thrust": -log.specific_force[part, 2:], **(speeds if known else {})},
        {name: values[part] for name, values in commands.items() if values is not None},
        log.speeds_measured,
    )


def _with_speeds(log: FlightLog, constants: Constants) -> tuple[FlightLog, bool]:
    """A log with the rotor speeds that its motor commands give, and whether its speeds are known.

    Without measured speeds, the flight starts later, whether or not the model has motors.
    """
    if log.speeds_measured:
        return log, True
    if all(hasattr(constants, name) for name in NAMES):
        values = np.array([float(getattr(constants, name)) for name in NAMES])
        return with_simulated_speeds(log, values), True
    return dataclasses.replace(log, flying=settled(log)), False


def commands_of(flight: Logged, model: VehicleModel) -> np.ndarray | None:
    """Logged commands (n, k) of a model; None if the log lacks one of them."""
    names = [signal.name for signal in model.commands]
    if not all(name in flight.commands for name in names):
        return None
    return np.concatenate([flight.commands[name] for name in names], axis=1)


def disturbances_of(flight: Logged, model: VehicleModel, params: VehicleParams) -> Signals:
    """External moment, N m, and force, m/s^2, (n, 3) body, by the onboard estimator.

    Empty for a model without an estimator, or a log without rotor speeds.
    """
    speeds = flight.actuators.get(model.actuators.name)
    if not model.can_be_disturbed or speeds is None:
        return {}
    estimator = estimator_params(model, params, 1.0 / flight.step)
    velocity = flight.attitude.inv().apply(flight.velocity)
    vectors = (flight.rates, flight.specific_force, velocity)
    rates, force, velocity = (Vec3(*jnp.asarray(x.T, jnp.float32)) for x in vectors)
    samples = Measurement(rates, force, Rotors(*jnp.asarray(speeds.T, jnp.float32)), velocity)

    def run(samples: Measurement) -> list[jax.Array]:
        def step(
            state: EstimatorState, sample: Measurement
        ) -> tuple[EstimatorState, list[jax.Array]]:
            state, *estimates = update(estimator, state, sample)
            return state, [each.array() for each in estimates]

        start = init(estimator, jax.tree.map(lambda x: x[0], samples))
        return jax.lax.scan(step, start, samples)[1]

    estimates = jax.jit(run)(samples)
    return {name: np.asarray(x) for name, x in zip(DISTURBANCES, estimates, strict=True)}


def states_of(
    flight: Logged,
    model: VehicleModel,
    sizes: Mapping[str, int],
    last_command: np.ndarray | None = None,
    disturbances: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """States (n, k) in the order of ``sizes``, names and sizes of the fields.

    Args:
        flight: the log.
        model: of the drone.
        sizes: see ``quadjax.export.race_tables.state_sizes``.
        last_command: (n, k) of the step before.
        disturbances: of ``disturbances_of``; zero if not given.

    Raises:
        InputError: a field that the log does not have.
    """
    euler = flight.attitude.as_euler("ZYX")[:, ::-1]
    own: dict[str, np.ndarray | None] = {
        "position": flight.position,
        "velocity": flight.velocity,
        "euler": euler,
        "quaternion": flight.attitude.as_quat()[:, [3, 0, 1, 2]],
        "rates": flight.rates,
        "last_command": last_command,
        **flight.actuators,
        **{name: np.zeros((len(euler), 3)) for name in DISTURBANCES},
        **(disturbances or {}),
    }
    for name, size in sizes.items():
        values = own.get(name)
        if values is None or values.shape[1] != size:
            raise InputError(
                f"{flight.path}: the model {model.name} has {name} ({size}), which no column of "
                "the log gives"
            )
    return np.concatenate([own[name] for name in sizes], axis=1).astype(np.float32)
