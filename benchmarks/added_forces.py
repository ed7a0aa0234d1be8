"""Forces and moments that residuals and plants add to the nominal model."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import PlantConfig
from quadjax.plant.plant import Physics, build_plant, forces, nominal_vehicle
from quadjax.vehicle.motor import nominal_force, nominal_moment
from quadjax.vehicle.residual import read_residual, residual_force_moment
from quadjax.vehicle.rigid_body import RigidBodyState


def of_residual(path: str, states: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Specific force along body z (n,), m/s^2, and moments (n, 3), N m, of a residual file."""
    residual = read_residual(path)

    def at(rpm: jax.Array, velocity: jax.Array, rates: jax.Array) -> tuple[jax.Array, jax.Array]:
        force, moment = residual_force_moment(
            residual, Rotors.of(rpm), Vec3.of(velocity), Vec3.of(rates)
        )
        return force, moment.array()

    force, moment = jax.jit(jax.vmap(at))(*states)
    return np.asarray(force), np.asarray(moment)


def of_plant(config: PlantConfig, states: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The same of a plant, high above the ground in still air."""
    plant, nominal, still = build_plant(config), nominal_vehicle(config).motor, Rotors.zero()
    none, aloft = Vec3.zero(), Vec3.of(jnp.array([0.0, 0.0, -100.0]))

    def at(rpm: jax.Array, velocity: jax.Array, rates: jax.Array) -> tuple[jax.Array, jax.Array]:
        speeds, v, w = Rotors.of(rpm), Vec3.of(velocity), Vec3.of(rates)
        body = RigidBodyState(aloft, v, none, w, speeds, none, none)
        force, moment = forces(plant, Physics(body, still, jnp.ones(())), still, v)
        model = nominal_force(nominal, speeds, v)
        return force.z - model.z, (moment - nominal_moment(nominal, speeds, still, v, w)).array()

    force, moment = jax.jit(jax.vmap(at))(*states)
    return np.asarray(force), np.asarray(moment)
