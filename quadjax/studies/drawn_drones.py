"""Drones drawn from the randomization of a config: their constants, as numbers and as files."""

import contextlib
import functools
from pathlib import Path

import jax
import numpy as np

from quadjax.config.checks import check_drone
from quadjax.config.race import race_of
from quadjax.config.schema import Config, Randomization
from quadjax.core.errors import InputError
from quadjax.race.laps import starting_states
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.protocol import Constants, VehicleModel
from quadjax.vehicle.summary import AXES, turns
from quadjax.vehicle.vehicle_file import VehicleFile, write_vehicle

SPARE = 4  # drones are drawn for each one that is written


def check_drawn(config: Config) -> None:
    """Refuse a config that draws no constants.

    Raises:
        InputError: it does not.
    """
    if not config.randomization.drawn:
        raise InputError(
            "randomization draws no constants, allowed: a fraction (randomization.all=0.2) or a "
            "population"
        )


def draw_drones(config: Config, count: int, seed: int) -> Constants:
    """Constants of drawn drones, each (count,).

    Args:
        config: of the race, with a randomization.
        count: number of drones.
        seed: of the constants.

    Raises:
        InputError: the config draws no constants.
    """
    check_drawn(config)
    choices, params = race_of(config.replace(schedules={}))
    states = starting_states(choices, params, jax.random.key(seed), count, True)
    assert states.constants is not None
    return reachable(choices.model, params.vehicle.constants, states.constants)


def reachable(model: VehicleModel, nominal: Constants, drawn: Constants) -> Constants:
    """Drawn constants (n,) of which those that limit the commands are within the nominal range.

    A policy commands the nominal range. Where a drawn limit is wider, the drone never reaches it.
    """
    found, wide = {}, values_of(drawn)
    for name, own in values_of(nominal).items():
        value = wide[name]
        more = model.command_range(replaced(nominal, {name: 1.01 * own}))
        ends = zip(more, model.command_range(nominal), strict=True)
        low, high = (_differ(*pair) for pair in ends)
        if low or high:
            found[name] = np.maximum(value, own) if low else np.minimum(value, own)
    return replaced(drawn, found)


def _differ(one: object, other: object) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return any(not np.array_equal(a, b) for a, b in pairs)


def quantities(model: VehicleModel, constants: Constants) -> dict[str, np.ndarray]:
    """What the drones can do, (n,) each, of those that differ.

    The thrust-to-weight ratio, the largest angular accelerations within 0.1 s of hover (see
    ``quadjax.vehicle.summary.turns``), the highest rotor speeds or commands of
    ``VehicleModel.ranges``, and the time constants.

    Args:
        model: of the vehicle.
        constants: each (n,).
    """
    constants = jax.tree.map(lambda x: np.asarray(x, np.float64), constants)
    values = values_of(constants)
    found: dict[str, np.ndarray] = {}
    ratio = model.thrust_to_weight(constants)
    if ratio is not None:
        found["thrust to weight"] = np.asarray(ratio)
    accelerations, _ = jax.jit(jax.vmap(functools.partial(turns, model)))(constants)
    found |= {
        f"{axis} acceleration": np.asarray(accelerations[:, index])
        for index, axis in enumerate(AXES)
    }
    found |= {name: values[name] for _, name in model.ranges}
    found |= {name: values[name] for name in model.lags}
    return {name: x for name, x in found.items() if x.ndim and np.ptp(x) > 0.0}


def write_drones(config: Config, count: int, seed: int, folder: Path) -> list[Path]:
    """Write the vehicle file of each drawn drone.

    Drawn drones that are refused as a vehicle, such as one whose moments of inertia are those of no
    body, are left out.

    Args:
        config: of the race, with a randomization.
        count: number of drones.
        seed: of the constants.
        folder: of the files ``drone_SEED_INDEX.yaml``.

    Returns:
        The files.

    Raises:
        InputError: the config draws no constants, too few drones are possible, or a file cannot be
            written.
    """
    possible = _possible(config, draw_drones(config, SPARE * count, seed))[:count]
    if len(possible) < count:
        found = f"{len(possible)} of {SPARE * count} drawn drones are possible"
        raise InputError(f"randomization: {found}, expected {count}")
    vehicle, paths = config.vehicle, []
    for index, own in enumerate(possible):
        name = f"drone_{seed}_{index}"
        model = vehicle.model
        drone = VehicleFile(name, {model: own}, model, width=vehicle.width)
        paths.append(folder / f"{name}.yaml")
        comment = f"Drone {index} of {config.name} with {vehicle.name}, drawn with seed {seed}."
        write_vehicle(paths[-1], drone, comment)
    return paths


def _possible(config: Config, drawn: Constants) -> list[dict[str, float]]:
    """The constants of the drones that are allowed in a vehicle file."""
    found = []
    columns = {name: np.asarray(x) for name, x in values_of(drawn).items()}
    for row in zip(*columns.values(), strict=True):
        own = {name: float(f"{x:.7g}") for name, x in zip(columns, map(float, row), strict=True)}
        vehicle = config.vehicle.replace(constants=own)
        with contextlib.suppress(InputError):
            check_drone(config.replace(vehicle=vehicle, randomization=Randomization()))
            found.append(own)
    return found
