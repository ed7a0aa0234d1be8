"""A flight log as states and commands of a vehicle model."""

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.motors import MAP, with_simulated_speeds
from quadjax.fitting.samples import settled
from quadjax.flights.flight import Flight, vehicle_signals
from quadjax.vehicle import estimator
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.estimator import EstimatorState
from quadjax.vehicle.protocol import Measurement, VehicleModel, VehicleParams

DISTURBANCES = ("moment_ext", "force_ext")  # fields of the state that no log has
COLUMNS = {  # signals of a log with the commands of a model, by the name of the command
    "rpm": "command",
    "motor_command": "motor_command",
    "body_rates": "rate_command",
    "thrust": "thrust_command",
}


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
        states |= {"rpm": flight["actuators"], "rotor_speed": flight["actuators"] / RPM_PER_RAD_S}
    names = [COLUMNS.get(signal.name, "") for signal in model.commands]
    commands = [flight[name] for name in names if name in flight.signals]
    nothing = np.zeros((len(flight.time), 0))
    command = np.concatenate(commands, axis=1) if len(commands) == len(names) else nothing
    of_model = vehicle_signals(model, command, states.get(model.actuators.name, nothing))
    signals = {name: value for name, value in flight.signals.items() if name not in of_model}
    signals |= {name: value for name, value in of_model.items() if value.values.size}
    return flight.replace(signals=signals, source=flight.source | {"measured": measured})


def estimate_disturbances(
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


def stack_states(
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
