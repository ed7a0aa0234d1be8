"""Size of residual models and of plants on the states of one flight: rows of ``size.json``.

``python -m benchmarks.residual_size [FILE.npz ...] [--plant NAME ...]`` measures what each
residual, and the median of 40 drones of each plant, adds to the nominal model along one flight of
six laps from hover (``e2e.npz``, mean action): the force along body z per mass in m/s^2 (down is
positive) and the moments in mN m.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import numpy as np

import quadjax
from benchmarks import rows
from benchmarks.added_forces import of_plant, of_residual
from benchmarks.settings import Tree
from quadjax.cli import options, script
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.resources import PRETRAINED
from quadjax.core.vectors import Vec3
from quadjax.plant.config import load_plant_config

RACE, POLICY = "e2e", "e2e.npz"  # of the flight
DRONES = 40  # of a plant


def states_of() -> list[np.ndarray]:
    """Propeller speeds, rpm, velocity, m/s, body, and rates, rad/s, of each sample (n, .)."""
    policy, once = PRETRAINED / POLICY, {"runs": 1, "laps": 6, "deterministic": True}
    flight = quadjax.evaluate(policy, RACE, **once).flights[0]

    def turned(velocity: jax.Array, euler: jax.Array) -> jax.Array:
        return world_to_body(attitude(Vec3.of(euler)), Vec3.of(velocity)).array()

    rpm, velocity, euler, rates = (
        flight[name].astype(np.float32) for name in ("actuators", "velocity", "attitude", "rates")
    )
    return [rpm, np.asarray(jax.vmap(turned)(velocity, euler)), rates]


def sizes(force: np.ndarray, moment: np.ndarray) -> list[float]:
    """Mean, RMS and largest force, RMS moments, and the standard deviations of all four."""
    rms = [np.sqrt((force**2).mean()), np.abs(force).max(), *np.sqrt((moment**2).mean(axis=0))]
    return [force.mean(), *rms, force.std(), *moment.std(axis=0)]


def row(name: str, command: str, values: Sequence[float], **plant: Sequence[str]) -> Tree:
    """The row of a residual or a plant."""
    rms, deviation = (
        ", ".join(f"{1e3 * x:.1f}" for x in part) for part in (values[3:6], values[7:])
    )
    return {
        "name": name,
        "command": f"python -m benchmarks.residual_size {command}",
        "race": [RACE],
        "policy": POLICY,
        **plant,
        "seeds": [0],
        "force": " / ".join(f"{x:.2f}" for x in values[:3]),
        "force deviation": f"{values[6]:.2f}",
        "moments": rms,
        "moment deviations": deviation,
    }


def residual_size(
    *files: str, plant: Annotated[tuple[options.PlantConfig, ...], options.LIST] = ()
) -> None:
    """Write the rows of residual files and plants."""
    states, made = states_of(), []
    for file in files:
        made.append(row(Path(file).stem, file, sizes(*of_residual(file, states))))
    for name in plant:
        config = load_plant_config(name)
        drones = [sizes(*of_plant(config.member(number), states)) for number in range(DRONES)]
        middle = np.quantile(drones, 0.5, axis=0)
        made.append(row(name, f"--plant {name}", middle, plant=[name]))
    rows.write("size", made)


if __name__ == "__main__":
    script(residual_size)
