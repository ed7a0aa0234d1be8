"""Published times of six laps from hover (Ferede et al., arXiv 2311.16948, Table I).

A published time is shown only next to flights of the same race and protocol. The rows are of
simulated flights. The table's flights of a real drone are left out: no race here reproduces them.
"""

import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.evaluation.rows import Row
from quadjax.race.laps import Laps
from quadjax.vehicle.residual import digest, read_residual

LAPS = 6


def _row(label: str, *laps: float) -> Row:
    times = np.array([laps])
    return Row(label, Laps(times, ("",), times.sum(axis=1), np.inf), published=True)


E2E = _row("E2E simulated, sampled", 2.97, 2.51, 2.56, 2.55, 2.59, 2.57)
INDI = _row("INDI simulated, sampled", 3.20, 2.82, 2.75, 2.80, 2.81, 2.76)
PRESETS = {"motor": ("e2e_table1", E2E), "rate": ("indi_table1", INDI)}  # by the vehicle's model
# SHA-256 of the numbers of the authors' residual, which flies the E2E row.
RESIDUAL = "72ee30a56a78da8d792491e80bce910f08c002f554d222bbbf349cdd1ceb1eab"


def published_row(config: Config) -> Row | None:
    """The published flights of the race of a config; None if there are none.

    The race of the E2E row is preset ``e2e_table1``: the nominal constants with the authors'
    residual, whose numbers are compared. That of the INDI row is preset ``indi_table1``: yaw rates
    up to 2 rad/s and thrust up to 16 m/s^2.
    """
    if config.vehicle.model not in PRESETS:
        return None
    preset, row = PRESETS[config.vehicle.model]
    residual = RESIDUAL if row is E2E else None
    return row if _race(config) == _reference(preset) and _residual(config) == residual else None


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
def _reference(preset: str) -> tuple[object, ...]:
    return _race(load_config(preset, ["vehicle.residual=null"]))


def _residual(config: Config) -> str | None:
    """The digest of the residual's numbers; None without a residual, "" where its file is gone."""
    if config.vehicle.residual is None:
        return None
    try:
        return digest(read_residual(Path(config.vehicle.residual)))
    except InputError:
        return ""


def published_flight(
    config: Config, laps: int, gates: int | None = None, *, deterministic: bool, from_hover: bool
) -> Row | None:
    """The published flights of the same race and protocol: sampled, six laps from hover.

    Args:
        config: of the race.
        laps: of a flight.
        gates: of a flight in place of laps.
        deterministic: whether the flights are of the mean action.
        from_hover: whether they start at hover.
    """
    same = not deterministic and from_hover and laps == LAPS and gates is None
    return published_row(config) if same else None


def published_sampled(config: Config) -> Row | None:
    """The published flights of a config's race and length, sampled from hover; None if none."""
    race = config.evaluate
    return published_flight(config, race.laps, race.gates, deterministic=False, from_hover=True)


def published_total(config: Config) -> tuple[str, float] | None:
    """Label and time, s, of the published flights that a training's ``lap_total`` compares with.

    None for another race, and where the training is scored by flights of the mean action.
    """
    row = published_sampled(config) if config.run.score == "sampled" else None
    return None if row is None else (f"Table I, {row.label}", round(row.total, 2))


def first_under(metrics: Mapping[str, np.ndarray], total: float) -> tuple[float, int] | None:
    """Seconds and environment steps of a training at its first ``lap_total`` under a time, s.

    Args:
        metrics: columns of ``metrics.csv``, (rows,) each.
        total: s.

    Returns:
        None if no flight was under the time.
    """
    under = np.flatnonzero(metrics["lap_total"] < total)
    if not under.size:
        return None
    return float(metrics["seconds"][under[0]]), int(metrics["steps"][under[0]])
