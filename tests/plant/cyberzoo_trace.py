"""What the published networks command in their first second on ``cyberzoo``, and what follows.

python -m tests.plant.cyberzoo_trace E2E.npz INDI.npz    # writes cyberzoo_trace.npz
"""

import sys
from pathlib import Path

import jax
import numpy as np

from quadjax.config.loading import load_config
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import flight, onboard
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.plant.flights import fly_plan, plan_race
from quadjax.policy.file import Policy
from quadjax.vehicle.rate import RateCommand

FILE = Path(__file__).with_suffix(".npz")
NAMES, DRONES, SAMPLES = ("e2e", "indi"), 4, 512


def plant() -> PlantConfig:
    """The plant in still air, with its state known exactly and full batteries."""
    zoo = load_plant_config("cyberzoo", ["navigation=ground_truth", "battery.charge=[1, 1]"])
    others = {key: values for key, values in zoo.population.items() if key != "effects.gusts"}
    return zoo.replace(population=others, effects=zoo.effects.replace(gusts=0.0))


def answered(name: str, commands: np.ndarray) -> np.ndarray:
    """States (drones, 13) after commands (samples, 4, drones), without noise.

    Position, velocity, rates and propeller speeds.
    """
    policy = Policy.load(name)
    options = {"lap_count": 1, "runs": DRONES, "drones": DRONES}
    plan = plan_race(load_config(name), plant(), policy, **options)
    drones = flight.begin(plan, jax.random.key(0))
    still = np.zeros((onboard.DRAWS, DRONES), np.float32)
    sample = jax.vmap(flight.sample, (flight.axes(plan), -1, -1, -1), -1)

    def one(drones: flight.Drones, command: jax.Array) -> tuple[flight.Drones, None]:
        given = Rotors(*command) if name == "e2e" else RateCommand(Vec3(*command[:3]), command[3])
        return sample(plan, drones, given, still)[0], None

    body = jax.jit(lambda: jax.lax.scan(one, drones, commands)[0])().plant.physics.body
    vectors = (body.position, body.velocity, body.rates, body.actuators)
    return np.stack([x for v in vectors for x in v.components()], axis=1)


def commanded(name: str, file: str) -> np.ndarray:
    """Commands (samples, 4, drones) of sampled flights of a policy."""
    race = load_config(
        {"e2e": "e2e_table1", "indi": "indi_table1"}[name],
        [f"vehicle.residual={file}" if name == "e2e" else "name=indi"],
    )
    options = {"lap_count": 1, "runs": DRONES, "drones": DRONES, "recorded": DRONES}
    plan = plan_race(race, plant(), Policy.load(file, race), deterministic=False, **options)
    return np.stack(jax.tree.leaves(fly_plan(plan).frames.command), axis=1)[:SAMPLES]


if __name__ == "__main__":
    arrays = {}
    for name, file in zip(NAMES, sys.argv[1:], strict=True):
        arrays[name] = commanded(name, file).astype(np.float32)
        arrays[f"{name}_state"] = answered(name, arrays[name])
    np.savez_compressed(FILE, **arrays)
