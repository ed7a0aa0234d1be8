"""Flights of a policy on the stand-in plant, of which only logs and results are kept."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.files import read_json, write_json
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import fly_plan
from quadjax.plant.logs import write_logs
from quadjax.plant.races import plan_race
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps

Report = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Flown:
    """Results of flights, by the rules of the race.

    Attributes:
        seconds: of each flight, until its end.
        totals: s of all laps; None where a flight did not finish.
        crashes: the reason of an early end; "" for none.
    """

    seconds: list[float]
    totals: list[float | None]
    crashes: list[str]

    @classmethod
    def of(cls, laps: Laps) -> Self:
        """The results of timed laps."""
        totals = [float(x) if np.isfinite(x) else None for x in laps.totals]
        seconds = [float(x) for x in np.asarray(laps.seconds)]
        return cls(seconds, totals, list(laps.crashes))

    @property
    def finished(self) -> int:
        """Number of flights that finished."""
        return sum(total is not None for total in self.totals)

    @property
    def mean(self) -> float:
        """Mean time of all laps over the flights that finished, s; NaN if none did."""
        done = [total for total in self.totals if total is not None]
        return float(np.mean(done)) if done else float("nan")

    def save(self, path: Path) -> None:
        """Write a JSON file."""
        write_json(path, dataclasses.asdict(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the JSON file."""
        values: dict[str, Any] = read_json(path)
        return cls(**values)


def fly_and_log(
    config: Config,
    plant: PlantConfig,
    policy: Path,
    name: str,
    folder: Path,
    count: int,
    laps: int,
    seed: int,
    report: Report,
) -> Flown:
    """Fly a policy's mean action, write the logs ``folder/NAME_RUN.csv``, and give the results.

    Args:
        config: of the race; its vehicle is the onboard model.
        plant: of the plant.
        policy: its file.
        name: of the logs.
        folder: of the logs.
        count: number of flights.
        laps: of each flight.
        seed: of batteries, gusts and sensors.
        report: called with the progress.
    """
    plant = plant.replace(control_rate=plant.sample_rate)
    options = {"lap_count": laps, "runs": count, "recorded": count}
    plan = plan_race(config, plant, Policy.load(policy), str(policy), **options)
    written = write_logs({name: plan}, folder, seed, report)
    totals = [log.total if np.isfinite(log.total) else None for log in written]
    return Flown([log.seconds for log in written], totals, [log.crash for log in written])


def fly(
    config: Config, plant: PlantConfig, policy: Path, count: int, laps: int, seed: int
) -> Flown:
    """Results of flights without logs; arguments as ``fly_and_log``."""
    plan = plan_race(
        config, plant, Policy.load(policy), str(policy), lap_count=laps, runs=count, recorded=1
    )
    return Flown.of(fly_plan(plan, seed).laps)
