"""The race and the lap times of Ferede et al. (arXiv 2311.16948): six laps from hover.

Published times stand next to own ones only where the race is the paper's; ``is_paper_race``
decides.
"""

import dataclasses
import functools

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config

LAPS = 6


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of a lap table; times in seconds, NaN where there is none."""

    label: str
    laps: tuple[float, ...]
    total: float
    best: float
    finished: int | None = None  # runs that completed every lap
    runs: int | None = None
    last_gates: int = 0  # gates of the last lap where it is a part of one


PUBLISHED = (
    Row("E2E simulated", (2.97, 2.51, 2.56, 2.55, 2.59, 2.57), 15.75, np.nan),
    Row("INDI simulated", (3.20, 2.82, 2.75, 2.80, 2.81, 2.76), 17.14, np.nan),
    Row("E2E flown, mean of 5", (3.22, 2.79, 2.85, 2.82, 2.84, 2.83), 17.35, 17.09),
    Row("INDI flown, mean of 5", (3.28, 2.80, 2.82, 2.82, 2.84, 2.83), 17.40, 17.26),
)

# Six laps of the published policies, s, by the vehicle model: measured with the authors' published
# networks, 20 sampled flights in the paper's model with the authors' residual. Neither networks nor
# residual are in this repository. The rows above are Table I of the paper.
TOTALS = {
    "motor": ("published E2E policy", 15.70),
    "rate": ("published INDI policy", 17.04),
}
PRESETS = {"motor": "e2e_paper", "rate": "indi_paper"}


@functools.cache
def _reference(kind: str) -> Config:
    return load_config(PRESETS[kind])


def is_paper_race(config: Config) -> bool:
    """Whether a race is the paper's: vehicle, track, rules and disturbances.

    Disturbances may be absent, or those with which the paper trained. Training limits, rewards and
    the learner do not matter: evaluation knows only the rules.
    """
    if config.vehicle.model not in PRESETS:
        return False
    paper = _reference(config.vehicle.model)
    return _race_of(config) == _race_of(paper) and _disturbance_of(config) in (
        _disturbance_of(paper),
        _disturbance_of(_reference("rate")),  # none
    )


def _race_of(config: Config) -> tuple[object, ...]:
    """The settings that determine lap times, as comparable values."""
    vehicle, own = config.vehicle, config.rules
    gates = (
        [gate.replace(yaw_deg=gate.yaw_deg % 360.0) for gate in config.track.gates],
        config.track.start,
    )
    drawn = config.randomization.drawn
    model = (vehicle.residual, vehicle.integrator, dict(vehicle.mismatch))
    return (vehicle.constants, gates, own, drawn, model)


def _disturbance_of(config: Config) -> dict[str, object]:
    return dict(config.disturbance)


def published_rows(config: Config, laps: int, from_hover: bool = True) -> tuple[Row, ...]:
    """The published flight of the same race, laps and start in the same model.

    It is of the sampled policy: compare it with sampled flights only. There is none for E2E, whose
    published simulation has the residual of a real drone that is not public. Flights of a real
    drone are never included.
    """
    same = from_hover and laps == LAPS and is_paper_race(config)
    if not (same and config.vehicle.model == "rate"):
        return ()
    return (dataclasses.replace(PUBLISHED[1], label=f"{PUBLISHED[1].label}, sampled"),)


def published_sampled(config: Config) -> Row | None:
    """The published flight of a config's race, of as many laps, sampled from hover; None if none.

    See ``published_rows``.
    """
    own = config.evaluate
    rows = published_rows(config, own.laps) if own.gates is None else ()
    return rows[0] if rows else None


def published_total(config: Config) -> tuple[str, float] | None:
    """Label and time, s, of the published policy; None where the race is not the paper's."""
    own = config.evaluate
    if own.laps == LAPS and own.gates is None and is_paper_race(config):
        return TOTALS[config.vehicle.model]
    return None
