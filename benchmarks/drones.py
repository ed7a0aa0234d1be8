"""Write vehicle files of drones that are drawn from the randomization of a config.

A policy can be trained or evaluated on one of them: quadjax train CONFIG vehicle=FILE. A limit of
the commands that is wider than that of the config's drone is replaced by the limit of that drone,
because a policy does not command more. Drawn drones that are refused as a vehicle, such as one
whose moments of inertia are those of no body, are left out.

    python -m benchmarks.drones e2e_race_robust --count 5 --output runs/drones
"""

import contextlib
from pathlib import Path
from typing import Annotated

import jax
import numpy as np

from quadjax.cli import script
from quadjax.cli.options import ConfigName, Folder, Overrides, Seed, whole
from quadjax.config.assembly import make_race
from quadjax.config.drone import check_drone
from quadjax.config.loading import load_config
from quadjax.config.schema import Randomization
from quadjax.core.errors import InputError
from quadjax.race.laps import starting_states
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.protocol import Constants
from quadjax.vehicle.vehicle_file import VehicleFile, write_vehicle

SPARE = 4  # drones are drawn for each one that is written


def draw_drones(config, count: int, seed: int) -> Constants:
    """Constants (count,) of drawn drones; an ``InputError`` if the config draws none."""
    if not config.randomization.drawn:
        raise InputError(
            "randomization draws no constants, allowed: a fraction (randomization.all=0.2) or a "
            "population"
        )
    environment, params = make_race(config.replace(schedules={}))
    states = starting_states(environment, params, jax.random.key(seed), count, True)
    return reachable(environment.model, params.vehicle.constants, states.constants)


def reachable(model, nominal: Constants, drawn: Constants) -> Constants:
    """Drawn constants (n,) of which those that limit the commands are within the nominal range."""
    limited, wide, ends = {}, values_of(drawn), model.command_range(nominal)
    for name, value in values_of(nominal).items():
        more = model.command_range(replaced(nominal, {name: 1.01 * value}))
        low, high = (_differ(*pair) for pair in zip(more, ends, strict=True))
        if low or high:
            limited[name] = (np.maximum if low else np.minimum)(wide[name], value)
    return replaced(drawn, limited)


def _differ(one, other) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return any(not np.array_equal(a, b) for a, b in pairs)


def write_drones(config, count: int, seed: int, folder: Path) -> list[Path]:
    """Write the vehicle files ``drone_SEED_INDEX.yaml`` of ``count`` drawn drones."""
    drawn, vehicle, files = values_of(draw_drones(config, SPARE * count, seed)), config.vehicle, {}
    for row in zip(*map(np.asarray, drawn.values())):
        constants = {name: float(f"{float(x):.7g}") for name, x in zip(drawn, row)}
        drone = config.replace(
            vehicle=vehicle.replace(constants=constants), randomization=Randomization()
        )
        with contextlib.suppress(InputError):
            check_drone(drone)
            name = f"drone_{seed}_{len(files)}"
            models, kind = {vehicle.model: constants}, vehicle.model
            files[folder / f"{name}.yaml"] = VehicleFile(name, models, kind, width=vehicle.width)
    if len(files) < count:
        possible = f"{len(files)} of {SPARE * count} drawn drones are possible"
        raise InputError(f"randomization: {possible}, expected {count}")
    for path in list(files)[:count]:
        comment = f"Drone of {config.name} with {vehicle.name}, drawn with seed {seed}."
        write_vehicle(path, files[path], comment)
    return list(files)[:count]


def drones(
    config: ConfigName,
    /,
    *overrides: Overrides,
    output: Folder,
    count: Annotated[int, whole(1, 1000)] = 5,
    seed: Seed = 0,
) -> None:
    """Draw ``count`` drones with ``seed``, write their files to a folder and print the paths."""
    for path in write_drones(load_config(config, overrides), count, seed, output):
        print(f"wrote {path}")


if __name__ == "__main__":
    script(drones)
