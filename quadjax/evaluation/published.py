"""Published times of six laps from hover (Ferede et al., arXiv 2311.16948, Table I).

A published row is next to flights of the same race and length only: those of simulated flights in
the simulator, those of the real drone on the plant ``cyberzoo``, which stands for it.
"""

import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS
from quadjax.evaluation.rows import Row
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.race.laps import Laps
from quadjax.vehicle.residual import digest, read_residual

LAPS = 6
REAL = "cyberzoo"  # name of the plant that stands for the real drone
FLOWN_E2E, FLOWN_INDI = (  # laps of the real drone, (flights, laps)
    np.array([[float(lap) for lap in flight.split()] for flight in text.split(";")])
    for text in (
        "3.23 2.79 2.81 2.84 2.84 2.83; 3.22 2.74 2.79 2.80 2.76 2.79; "
        "3.20 2.73 2.91 2.76 2.85 2.83; 3.22 2.85 2.89 2.87 2.87 2.81; "
        "3.24 2.81 2.85 2.86 2.87 2.88",
        "3.30 2.86 2.80 2.86 2.91 2.79; 3.26 2.79 2.80 2.79 2.84 2.77; "
        "3.25 2.80 2.83 2.86 2.76 2.84; 3.27 2.78 2.82 2.76 2.83 2.83; "
        "3.31 2.80 2.86 2.81 2.87 2.94",
    )
)


def _row(label: str, laps: np.ndarray) -> Row:
    return Row(label, Laps(laps, ("",) * len(laps), laps.sum(axis=1), np.inf))


E2E = _row("E2E simulated, sampled", np.array([[2.97, 2.51, 2.56, 2.55, 2.59, 2.57]]))
INDI = _row("INDI simulated, sampled", np.array([[3.20, 2.82, 2.75, 2.80, 2.81, 2.76]]))
FLOWN = {  # by the vehicle's model
    "motor": _row("E2E, real flights", FLOWN_E2E),
    "rate": _row("INDI, real flights", FLOWN_INDI),
}
PRESETS = {"motor": ("e2e_table1", E2E), "rate": ("indi_table1", INDI)}  # by the vehicle's model
# SHA-256 of the numbers of the authors' residual, which flies the E2E row.
RESIDUAL = "72ee30a56a78da8d792491e80bce910f08c002f554d222bbbf349cdd1ceb1eab"


def published_row(config: Config) -> Row | None:
    """The published flights of the race of a config; None if there are none.

    The race of the E2E row is preset ``e2e_table1``: the nominal constants with the authors'
    residual, whose numbers are compared. That of the INDI row is preset ``indi_table1``: yaw rates
    up to 2 rad/s and thrust up to 16 m/s^2.
    """
    preset, row = PRESETS.get(config.vehicle.model, ("", None))
    if row is None or _race(config) != _reference(preset):
        return None
    residual, file = None, config.vehicle.residual
    if file is not None:
        try:
            residual = digest(read_residual(Path(file)))
        except InputError:
            return None
    return row if residual == (RESIDUAL if row is E2E else None) else None


def flown_row(config: Config, plant: PlantConfig, laps: int | None) -> Row | None:
    """The flights of the real drone, for a policy on the plant of that drone, on its track.

    None for a plant with other numbers, another track or another number of laps. Any drone of the
    plant may fly.
    """
    track = _race(config)[2:4]
    if laps != LAPS or track != _reference(PRESETS["motor"][0])[2:4]:
        return None
    alike = plant.model_copy(update={"name": REAL, "drone": 0}) == _real_drone()
    return FLOWN[config.vehicle.model] if alike else None


def _race(config: Config) -> tuple[object, ...]:
    """The settings that determine timed flights from hover, without the residual.

    It omits rewards, random starts and training limits. Yaw angles of gates are taken modulo
    360 deg.
    """
    vehicle, track = config.vehicle, config.track
    return (
        (vehicle.model, vehicle.constants, vehicle.mismatch, vehicle.residual_gain),
        (vehicle.quaternion, vehicle.integrator),
        tuple(gate.replace(yaw_deg=gate.yaw_deg % 360.0) for gate in track.gates),
        (track.start, track.closed),
        (config.rules, config.disturbance, config.randomization, config.battery),
    )


@functools.cache
def _real_drone() -> PlantConfig:
    return load_plant_config(CONFIGS / "plant" / f"{REAL}.yaml")


@functools.cache
def _reference(preset: str) -> tuple[object, ...]:
    return _race(load_config(preset, ["vehicle.residual=null"]))


def published_total(config: Config) -> tuple[str, float] | None:
    """Label and time, s, of the published flights that a training's ``lap_total`` compares with.

    None for another race, and where the training is scored by flights of the mean action.
    """
    alike = (config.run.score, config.evaluate.laps, config.evaluate.gates)
    row = published_row(config) if alike == ("sampled", LAPS, None) else None
    return None if row is None else (f"Table I, {row.policy}", round(row.total, 2))


def first_under(metrics: Mapping[str, np.ndarray], total: float) -> tuple[float, int] | None:
    """Seconds and environment steps of a training at its first ``lap_total`` under a time, s.

    ``metrics`` has the columns of ``metrics.csv``, (rows,) each. None if no flight was under it.
    """
    under = np.flatnonzero(metrics["lap_total"] < total)
    if not under.size:
        return None
    return float(metrics["seconds"][under[0]]), int(metrics["steps"][under[0]])
