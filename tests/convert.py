"""Between the rows of ``tests.reference`` and the project's pytrees, by the fields' names."""

import jax.numpy as jnp
import numpy as np

from quadjax.core.mlp import to_params
from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.rate import RateCommand, RateConstants
from quadjax.vehicle.residual import Residual
from quadjax.vehicle.rigid_body import RigidBodyState
from tests import reference as ref


def vec3(columns: np.ndarray) -> Vec3:
    return Vec3(*(jnp.asarray(x) for x in np.moveaxis(columns, -1, 0)))


def rotors(columns: np.ndarray) -> Rotors:
    return Rotors(*(jnp.asarray(x) for x in np.moveaxis(columns, -1, 0)))


def constants(kind: str, values: dict) -> MotorConstants | RateConstants:
    schema = MotorConstants if kind == "motor" else RateConstants
    return schema(**{name: jnp.asarray(value, float) for name, value in values.items()})


def state_of(kind: str, rows: np.ndarray) -> RigidBodyState:
    pose = {
        "position": vec3(rows[..., ref.P]),
        "velocity": vec3(rows[..., ref.V]),
        "attitude": vec3(rows[..., ref.EULER]),
        "rates": vec3(rows[..., ref.RATES]),
    }
    if kind == "rate":
        return RigidBodyState(**pose, actuators=jnp.asarray(rows[..., 12]))
    return RigidBodyState(
        **pose,
        actuators=rotors(rows[..., ref.RPM]),
        moment_ext=vec3(rows[..., ref.MOMENT]),
        force_ext=vec3(rows[..., ref.FORCE]),
    )


def rows_of(state: RigidBodyState) -> np.ndarray:
    def columns(vector: Vec3 | Rotors) -> list[np.ndarray]:
        return [np.asarray(getattr(vector, name)) for name in vars(vector)]

    drone = [*map(columns, (state.position, state.velocity, state.euler, state.rates))]
    if state.moment_ext is None:
        drone.append([np.asarray(state.actuators)])
    else:
        drone += map(columns, (state.actuators, state.moment_ext, state.force_ext))
    flat = np.broadcast_arrays(*(column for part in drone for column in part))
    return np.stack(flat, axis=-1)


def command_of(kind: str, rows: np.ndarray) -> Rotors | RateCommand:
    if kind == "motor":
        return rotors(rows)
    return RateCommand(vec3(rows[..., :3]), jnp.asarray(rows[..., 3]))


def residual_of(values: dict) -> Residual:
    return Residual(
        thrust=to_params(values["thrust"]),
        moment=to_params(values["moment"]),
        rpm_min=jnp.asarray(values["rpm_min"], float),
        rpm_max=jnp.asarray(values["rpm_max"], float),
        thrust_sign=jnp.asarray(values["thrust_sign"], float),
    )
