"""Simulated flights of a policy in its own race: data for its tests, and checks of them."""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.export.race_source import PolicyRace
from quadjax.export.states import LAST_COMMAND, observe, state_sizes
from quadjax.policy import pilot
from quadjax.policy.pilot import command_ranges
from quadjax.race.laps import Laps, Trace, fly_laps
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM

LOST_CONTROL = (  # of TERMINATIONS
    "lost its attitude",
    "out of bounds",
    "above the body rate limit",
    "above the training limit of the yaw rate",
    "not finite",
)
RUNS, LAPS, SEED = 32, 6, 0
FINISHED = 0.9  # fraction of the flights that must finish
KEPT_ROWS = 20_000  # rows of the simulated flights that are converted and verified


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """Simulated flights, one row per step of a drone that is still racing."""

    observations: np.ndarray  # (n, inputs) float32
    states: np.ndarray  # (n, state_size) float32, in the order of the emitted state
    targets: np.ndarray  # (n,) int32
    laps: Laps  # of all flights
    paths: list[tuple[np.ndarray, np.ndarray]]  # of each: positions (k, 3), targets (k,)

    def thinned(self) -> "Rollouts":
        """At most ``KEPT_ROWS`` rows, evenly spread."""
        count = len(self.states)
        rows = np.linspace(0, count - 1, min(KEPT_ROWS, count)).astype(int)
        kept = (self.observations[rows], self.states[rows], self.targets[rows])
        return Rollouts(*kept, self.laps, self.paths)


def simulate(race: PolicyRace, runs: int = RUNS, laps: int = LAPS, seed: int = SEED) -> Rollouts:
    """Simulate the float policy's mean actions from the random starts of training.

    The rows are those of all flights but the ones that lost control, or of all if every one did.
    """
    flown = (race.environment, race.params, pilot.act, race.pilot)
    key = jax.random.key(seed)
    result, trace = fly_laps(*flown, key, laps, runs, from_hover=False, trace=True)
    assert trace is not None
    controlled = np.array([crash not in LOST_CONTROL for crash in result.crashes])
    going = ~np.asarray(trace.over) & (controlled if controlled.any() else ~controlled)
    states, targets = _states(trace, race, going, seed), np.asarray(trace.target)[going]
    observations = observe(race, states, targets)
    return Rollouts(observations, states, targets, result, list(_paths(trace, race)))


def _paths(trace: Trace, race: PolicyRace) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Positions and targets of each flight; with those at its end, but for an open track."""
    over, last = np.asarray(trace.over), int(race.params.track.closed)
    position, target = np.asarray(trace.position), np.asarray(trace.target)
    for run, steps in enumerate(np.sum(~over, axis=0)):
        yield position[: steps + last, :, run], target[: steps + last, run]


def _states(trace: Trace, race: PolicyRace, going: np.ndarray, seed: int) -> np.ndarray:
    """States (n, state_size) float32 of the steps (time, runs) that are ``going``."""
    model = race.environment.model
    sizes = state_sizes(race.environment.layout, model)
    parts: dict[str, Any] = {
        name: getattr(trace, name) for name in ("position", "velocity", "euler", "rates")
    }
    parts[model.actuators.name] = trace.actuators
    if "quaternion" in sizes:
        q = quaternion.of_euler(Vec3(*np.moveaxis(np.asarray(trace.euler, np.float32), 1, 0)))
        parts["quaternion"] = np.stack([np.asarray(x) for x in jax.tree.leaves(q)], axis=1)
    if LAST_COMMAND in sizes:
        low, high = command_ranges(race.environment, race.params)
        first = np.broadcast_to(0.5 * (low + high)[:, None], trace.command.shape[1:])
        parts[LAST_COMMAND] = np.concatenate([first[None], np.asarray(trace.command)[:-1]])
    if HIGHEST_RPM in sizes:
        parts[HIGHEST_RPM] = np.asarray(trace.highest_rpm)[:, None]
    rows = {name: np.moveaxis(np.asarray(array), 1, -1)[going] for name, array in parts.items()}
    if model.disturbed:
        # Disturbances are constant in a flight; they are drawn again from their ranges.
        rng, names = np.random.default_rng(seed), itertools.chain(*DISTURBANCES.values())
        half = np.array([float(getattr(race.params.disturbance, name)) for name in names])
        disturbances = rng.uniform(-half, half, (going.shape[1], 4))[np.nonzero(going)[1]]
        rows["moment_ext"] = disturbances[:, :3]
        rows["force_ext"] = np.append(np.zeros((len(disturbances), 2)), disturbances[:, 3:], axis=1)
    return np.concatenate([rows[name] for name in sizes], axis=1).astype(np.float32)


def check_finished(laps: Laps, race: PolicyRace, who: str) -> str:
    """Check that at least the fraction ``FINISHED`` of a policy's flights finish.

    Returns:
        The number of flights that finish, as text for a report.

    Raises:
        InputError: too few flights finish.
    """
    said = f"{laps.finished} of {len(laps.crashes)} flights finish {laps.lap_times.shape[1]} laps"
    if laps.finished < FINISHED * len(laps.crashes):
        where = f"track {race.track} ({race.origin})"
        raise InputError(
            f"{who}: {said} of {where}, expected {FINISHED:.0%}; --allow-unfinished accepts it"
        )
    return said
