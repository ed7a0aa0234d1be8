"""Table I of Ferede et al. (arXiv 2311.16948): the races and the times of six laps from hover.

A published time is shown only next to flights of the same race (``is_e2e_table1``,
``is_indi_table1``) and protocol (``published_flight``).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import build_params, build_vehicle
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.traced import with_leaves
from quadjax.race.environment import exact_rules
from quadjax.vehicle.registry import model
from quadjax.vehicle.residual import digest

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

E2E_ROW, INDI_ROW = PUBLISHED[:2]
# SHA-256 of the numbers of the authors' residual: quadjax.vehicle.residual.digest.
RESIDUAL = "72ee30a56a78da8d792491e80bce910f08c002f554d222bbbf349cdd1ceb1eab"


def is_e2e_table1(config: Config) -> bool:
    """Whether timed flights from hover are in the race of the simulated E2E row.

    That is preset ``e2e_table1``: the nominal constants with the authors' residual, whose numbers
    are compared, and no disturbances.
    """
    vehicle = config.vehicle
    if vehicle.model != "motor" or vehicle.residual is None or not _same("e2e_table1", config):
        return False
    try:
        residual = build_vehicle(config).residual
    except InputError:  # a run whose residual was removed
        return False
    return residual is not None and digest(residual) == RESIDUAL


def is_indi_table1(config: Config) -> bool:
    """Whether timed flights from hover are in the race of the simulated INDI row.

    That is preset ``indi_table1``: yaw rates up to 2 rad/s and thrust up to 16 m/s^2.
    """
    return config.vehicle.model == "rate" and _same("indi_table1", config)


def _same(preset: str, config: Config) -> bool:
    """Whether the race of a config, without residual, has the numbers of a preset's."""
    if config.randomization.tracks is not None or config.rules.extra:
        return False
    own, other = _race(_without_residual(config)), _reference(preset)
    (*words, track, rest), (*other_words, other_track, other_rest) = own, other
    return (
        words == other_words
        and _close(track, other_track, 1e-6)  # m; yaws differ by whole turns
        and _close(rest, other_rest, 0.0)
    )


@functools.cache
def _reference(preset: str) -> tuple[object, ...]:
    return _race(load_config(preset, ["vehicle.residual=null"]))


def _without_residual(config: Config) -> Config:
    vehicle = config.vehicle.replace(residual=None, residual_gain=1.0)
    return config.replace(vehicle=vehicle)


def _race(config: Config) -> tuple[object, ...]:
    """What determines timed flights from hover: the choices of code, the track, other numbers.

    Rewards, starts and limits of the training have no effect on them. No module that a config names
    is imported, so a config of a run's folder may be compared.
    """
    params = build_params(config)
    zero, params = jnp.zeros(()), exact_rules(model(config.vehicle.model), params)
    limits = with_leaves(params.training_limits, episode_steps=zero)
    track = dataclasses.replace(params.track, yaw=zero, next_yaw=zero)  # sine and cosine remain
    numbers = {
        "constants": params.vehicle.constants,
        "rules": params.rules,
        "limits": limits,
        "disturbance": params.disturbance,
        "randomization": params.randomization,
        "mismatch": params.mismatch,
        "battery": params.battery,
    }
    vehicle, population = config.vehicle, config.randomization.population
    words = (vehicle.quaternion, vehicle.integrator, config.rules.gate_test, population)
    return (*words, track, numbers)


def _close(first: object, second: object, atol: float) -> bool:
    numbers, others = _numbers(first), _numbers(second)
    return numbers.keys() == others.keys() and all(
        np.shape(x) == np.shape(others[name]) and np.allclose(x, others[name], 1e-6, atol)
        for name, x in numbers.items()
    )


def _numbers(tree: object) -> dict[str, jax.Array]:
    """The leaves of a tree by their paths."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def published_flight(
    config: Config, laps: int, gates: int | None = None, *, deterministic: bool, from_hover: bool
) -> Row | None:
    """The published flights of the same race and protocol: sampled, six laps from hover.

    Flights of a real drone are never returned.

    Args:
        config: of the race.
        laps: of a flight.
        gates: of a flight in place of laps.
        deterministic: whether the flights are of the mean action.
        from_hover: whether they start at hover.
    """
    if deterministic or not from_hover or laps != LAPS or gates is not None:
        return None
    for row, is_race in ((E2E_ROW, is_e2e_table1), (INDI_ROW, is_indi_table1)):
        if is_race(config):
            return dataclasses.replace(row, label=f"{row.label}, sampled")
    return None


def published_sampled(config: Config) -> Row | None:
    """The published flights of a config's race and length, sampled from hover; None if none."""
    own = config.evaluate
    return published_flight(config, own.laps, own.gates, deterministic=False, from_hover=True)


def published_total(config: Config) -> tuple[str, float] | None:
    """Label and time, s, of the published flights that a training's ``lap_total`` compares with.

    None for another race, and where the training is scored by flights of the mean action.
    """
    row = published_sampled(config) if config.run.score == "sampled" else None
    return None if row is None else (f"Table I, {row.label}", row.total)
