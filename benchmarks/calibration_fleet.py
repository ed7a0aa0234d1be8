"""Both published policies on many drones at once, each in its own process on its own core."""

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import quadjax
from benchmarks.calibration_likelihood import NUMBERS
from benchmarks.calibration_summary import summary
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import fly_plan, plan_race
from quadjax.policy.file import Policy

RACES = {"E2E": "e2e_table1", "INDI": "indi_table1"}
_OWN: list[tuple[str, Config, Policy]] = []  # of a process


def race_config(name: str, file: Path) -> Config:
    """The race of a policy; E2E has the residual of its file on board."""
    return quadjax.load(RACES[name], [f"vehicle.residual={file}"] if name == "E2E" else [])


def half_width(name: str, file: Path) -> float:
    """Mean half width, m, of simulated paths along x and y."""
    flown = quadjax.evaluate(file, race_config(name, file), runs=5, laps=6).flights
    return float(np.mean([0.5 * np.ptp(each["position"][:, :2], axis=0) for each in flown]))


def _begin(name: str, file: Path, core: int) -> None:
    os.sched_setaffinity(0, {core})
    enable_compilation_cache()
    race = race_config(name, file)
    _OWN.append((name, race, Policy.load(file, race)))


def _fly(plant: PlantConfig, drones: int, flights: int, seed: int) -> dict[str, np.ndarray]:
    ((name, race, policy),) = _OWN
    runs = {"runs": drones * flights, "recorded": drones, "drones": drones}
    plan = plan_race(race, plant, policy, name, deterministic=False, **runs)
    return summary(name, fly_plan(plan, seed), drones)


class Fleet:
    """The policies of files, by name, in processes."""

    def __init__(self, files: dict[str, Path]) -> None:
        context = multiprocessing.get_context("spawn")
        cores: Sequence[int] = sorted(os.sched_getaffinity(0))
        self.pools = {
            name: ProcessPoolExecutor(
                1,
                mp_context=context,
                initializer=_begin,
                initargs=(name, file, cores[number % len(cores)]),
            )
            for number, (name, file) in enumerate(files.items())
        }

    def fly(self, plant: PlantConfig, drones: int, flights: int, seed: int) -> np.ndarray:
        """The ``NUMBERS`` (drones, numbers) of six laps of sampled flights of each drone."""
        waiting = [pool.submit(_fly, plant, drones, flights, seed) for pool in self.pools.values()]
        found = {key: x for each in waiting for key, x in each.result().items()}
        return np.stack([found[key] for key in NUMBERS], axis=1)
