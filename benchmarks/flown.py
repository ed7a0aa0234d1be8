"""Trainings and flights that the rows of a comparison are made of."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import quadjax
from quadjax.cli.fit import fit
from quadjax.cli.logs import logs
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.rows import Row
from quadjax.plant.config import load_plant_config

LAPS, SEED = 6, 2000  # of the flights; the seed of their noise
LOGGED = 6  # flights of each policy for a fit


def trained(preset: str, words: Sequence[str], seed: int, folder: Path) -> quadjax.Policy:
    """The policy of a training, which is resumed, or read if it has ended.

    Raises:
        InputError: a training that was stopped.
    """
    config = quadjax.load(preset, [*words, f"seed={seed}", "run.devices=1"])
    run = quadjax.train(config, folder, resume=True)
    if not run.summary["finished"]:
        raise InputError(f"{folder}: stopped before its end; the same command resumes it")
    return run.policy


def identified(folder: Path, plant: Sequence[str], policies: Sequence[str]) -> Path:
    """The folder of the fit to logs of shipped policies on a drone, made if it is not there."""
    written, found = folder / "logs", folder / "fit"
    if not list(written.glob("*.csv")):
        files = [PRETRAINED / f"{name}.npz" for name in policies]
        logs(*plant, output=written, policy=files, flights=LOGGED)
    if not (found / "vehicle.yaml").exists():
        words = [f"logs.files=[{(written / '*.csv').resolve()}]", "figures=false"]
        fit(plant[0], *words, output=folder, name="fit")
    return found


def flown(
    policy: quadjax.Policy, plant: Sequence[str], flights: int, drones: int = 1
) -> tuple[Row, Row]:
    """Flights on a plant, a number on each drone: sampled, and with the mean action."""
    loaded = load_plant_config(plant[0], plant[1:])
    options: dict[str, Any] = {"plant": loaded, "laps": LAPS, "seed": SEED, "drones": drones}
    sampled, mean = (
        quadjax.evaluate(policy, runs=flights * drones, deterministic=how, **options).rows[0]
        for how in (False, True)
    )
    return sampled, mean


def numbers(sampled: Row, mean: Row) -> dict[str, Any]:
    """Laps of the sampled flights on each drone, ends, and what the mean action reaches.

    Laps (drones, flights, laps) are in s; those of a flight that does not finish are null.
    """
    laps = np.asarray(sampled.laps.lap_times, float).round(3)
    done = np.isfinite(laps).all(axis=1, keepdims=True)
    each = np.where(done, laps, np.nan).reshape(sampled.drones, -1, laps.shape[1])
    return {
        "laps": [[[_number(x) for x in flight] for flight in flights] for flights in each],
        "ends": sampled.ends,
        "mean action": _number(mean.total),
        "mean action, finished": mean.finished,
    }


def _number(seconds: float) -> float | None:
    return round(float(seconds), 3) if math.isfinite(seconds) else None
