"""Simulated flights of a policy in its own race: data for its tests, and checks of them."""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.export.emulator import fixed_point_fly
from quadjax.export.race_source import PolicyRace
from quadjax.export.race_tables import LAST_COMMAND, state_sizes
from quadjax.export.states import observe
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import command_ranges
from quadjax.race import openings
from quadjax.race.laps import Actor, Laps, Trace, fly_laps
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.race.track import gate

Carry = tuple[jax.Array, jax.Array]  # a position and the target after it
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
    laps: Laps | None = None  # of all flights
    steps: int = 0  # of all flights

    def thinned(self) -> "Rollouts":
        """At most ``KEPT_ROWS`` rows, evenly spread."""
        count = len(self.states)
        rows = np.linspace(0, count - 1, min(KEPT_ROWS, count)).astype(int)
        return Rollouts(
            self.observations[rows], self.states[rows], self.targets[rows], self.laps, self.steps
        )


def simulate(race: PolicyRace, runs: int = RUNS, laps: int = LAPS, seed: int = SEED) -> Rollouts:
    """Simulate the float policy's mean actions from the random starts of training.

    The rows are those of all flights but the ones that lost control, or of all if every one did.
    """
    result, trace = _fly(race, pilot.act, runs, laps, seed, trace=True)
    assert trace is not None
    controlled = np.array([crash not in LOST_CONTROL for crash in result.crashes])
    going = ~np.asarray(trace.over) & (controlled if controlled.any() else ~controlled)
    states, targets = _states(trace, race, going, seed), np.asarray(trace.target)[going]
    return Rollouts(observe(race, states, targets), states, targets, result, len(states))


def _fly(
    race: PolicyRace, actor: Actor, runs: int, laps: int, seed: int, **options: bool
) -> tuple[Laps, Trace | None]:
    options = {"from_hover": False} | options
    key = jax.random.key(seed)
    return fly_laps(race.environment, race.params, actor, race.pilot, key, laps, runs, **options)


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


def check_finished(laps: Laps | None, race: PolicyRace, who: str) -> str:
    """Check that at least the fraction ``FINISHED`` of a policy's flights finish.

    Returns:
        The number of flights that finish, as text for a report.

    Raises:
        InputError: too few flights finish.
    """
    assert laps is not None
    said = f"{laps.finished} of {len(laps.crashes)} flights finish {laps.lap_times.shape[1]} laps"
    if laps.finished < FINISHED * len(laps.crashes):
        where = f"track {race.track} ({race.origin})"
        raise InputError(
            f"{who}: {said} of {where}, expected {FINISHED:.0%}; --allow-unfinished accepts it"
        )
    return said


def fly_float_and_fixed(
    race: PolicyRace,
    policy: Policy,
    ranges: dict[str, float],
    runs: int,
) -> tuple[Laps, Laps]:
    """Flights of six laps of the float policy and of the fixed-point one, from the same starts."""
    actors = (pilot.act, fixed_point_fly(policy, ranges))
    as_float, as_fixed = (_fly(race, actor, runs, laps=6, seed=1)[0] for actor in actors)
    return as_float, as_fixed


def wander(race: PolicyRace, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A path to every gate in turn, partly through the openings and partly outside them.

    Returns:
        Positions (steps, 3) float32, and the target (steps,) after each by the simulator's rules.
    """
    rng = np.random.default_rng(seed)
    track = race.params.track
    centers = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    ahead = np.stack([np.asarray(track.cos_yaw), np.asarray(track.sin_yaw)], axis=1)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)

    test = "world_box" if race.params.rules.gate_test == "world_box" else "square"

    def follow(carry: Carry, after: jax.Array) -> tuple[Carry, jax.Array]:
        before, target = carry
        ends = (Vec3.of(before), Vec3.of(after))
        passed, _ = openings.crossing(*ends, gate(track, target), jnp.zeros(()), test)
        following = (target + passed.astype(jnp.int32)) % len(centers)
        return (after, following), following

    follow = jax.jit(functools.partial(jax.lax.scan, follow))
    target, position = 0, centers[-1].astype(np.float32)
    positions: list[np.ndarray] = []
    targets: list[int] = []
    while len(targets) < steps:
        aside, above = rng.uniform(-1.6, 1.6, 2) * half[target]
        way = np.array([*ahead[target], 0.0])
        goal = centers[target] + np.array([-way[1] * aside, way[0] * aside, above])
        ends = np.array([position, goal - 0.5 * way, goal + 0.5 * way])
        fractions = np.linspace(0.04, 1.0, 25)[:, None]
        legs = [a + fractions * (b - a) for a, b in itertools.pairwise(ends)]
        leg = np.concatenate(legs).astype(np.float32)
        _, after = follow((position, jnp.int32(target)), leg)
        positions += list(leg)
        targets += after.tolist()
        target, position = targets[-1], leg[-1]
    return np.array(positions[:steps], np.float32), np.array(targets[:steps], np.int32)
