"""Size of residual models on the states of one nominal E2E flight.

``python benchmarks/residual_size.py FILE.npz ...`` prints what each residual adds to the nominal
model along one flight of six laps from hover (policy ``e2e_nominal.npz``, mean action): the force
along body z per mass in m/s^2 (down is positive) and the moments in N m.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import quadjax
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.resources import PRETRAINED
from quadjax.core.vectors import Rotors, Vec3
from quadjax.flights import Flight
from quadjax.vehicle.residual import read_residual, residual_force_moment


def nominal_flight() -> Flight:
    """Six laps of the mean action of ``e2e_nominal.npz`` on the nominal model."""
    laps = quadjax.evaluate(
        PRETRAINED / "e2e_nominal.npz", "e2e", runs=1, laps=6, deterministic=True
    )
    return laps.flights[0]


def outputs(path: str, flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Specific force along body z (n,), m/s^2, and moments (n, 3), N m, of a residual file."""
    residual = read_residual(path)

    def at(rpm: jax.Array, velocity: jax.Array, euler: jax.Array, rates: jax.Array) -> jax.Array:
        body_velocity = world_to_body(attitude(Vec3.of(euler)), Vec3.of(velocity))
        force, moment = residual_force_moment(
            residual, Rotors.of(rpm), body_velocity, Vec3.of(rates)
        )
        return jnp.concatenate([force[None], moment.array()])

    signals = [flight[name] for name in ("actuators", "velocity", "attitude", "rates")]
    values = np.asarray(jax.jit(jax.vmap(at))(*(signal.astype(np.float32) for signal in signals)))
    return values[:, 0], values[:, 1:]


def row(path: str, flight: Flight) -> str:
    """A line of the table."""
    force, moment = outputs(path, flight)
    sizes = f"{force.mean():.2f} / {np.sqrt((force**2).mean()):.2f} / {np.abs(force).max():.2f}"
    moments = ", ".join(f"{x:.4f}" for x in np.sqrt((moment**2).mean(axis=0)))
    return f"| `{Path(path).name}` | {sizes} | {moments} |"


if __name__ == "__main__":
    states = nominal_flight()
    print("| residual | Fz mean / rms / largest, m/s^2 | Mx, My, Mz rms, N m |\n|---|---|---|")
    for name in sys.argv[1:]:
        print(row(name, states))
