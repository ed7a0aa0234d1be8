"""Schedules: numbers of a run that change during training.

A schedule is built from the run's numbers at each of its knots: the whole pytree of hyperparameters
and environment parameters, once per knot. The leaves that differ are the scheduled ones. Between
two knots a leaf is interpolated linearly in environment steps,

    ``leaf = A + fraction (B - A)``,  ``fraction = clip((steps - t_A) / (t_B - t_A), 0, 1)``,

before the first knot it has the first value, after the last one the last. Knots and values are
traced: other numbers for the same leaves do not trigger recompilation.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.learners.section import Curriculum, Schedule
from quadjax.learners.state import Learner, Metrics, TrainState

Tree = Any  # a pytree


@struct.dataclass
class Knots:
    """Values of some leaves of a pytree at each knot."""

    knots: jax.Array  # (k,) number of updates, or levels, not decreasing
    rates: jax.Array  # (k - 1,) 1 / (distance between two knots); 0 if there is none
    values: tuple[jax.Array, ...]  # (k, *shape of the leaf), one for each scheduled leaf
    leaves: tuple[int, ...] = struct.field(pytree_node=False)  # their indices in the flat pytree
    by_level: bool = struct.field(pytree_node=False, default=False)  # else by updates


@struct.dataclass
class Climb:
    """How the level of the schedules by ``pass_rate`` changes."""

    pass_rate: jax.Array  # () at which it begins to rise
    rate: jax.Array  # () largest change per update


@struct.dataclass
class Scheduled:
    """Hyperparameters of a learner together with the schedules of the run."""

    hyper: Tree
    schedules: tuple[Knots, ...]
    climb: Climb | None = None  # where a schedule follows the level


def make_schedule(
    key: str,
    steps: Sequence[float],
    trees: Sequence[Tree],
    steps_per_update: int,
    by_level: bool = False,
) -> Knots:
    """A schedule from the run's numbers at each knot.

    Args:
        key: what is scheduled, for error messages.
        steps: environment steps at each knot, not decreasing.
        trees: ``(hyperparameters, environment parameters)`` at each knot, of one structure. Only
            leaves of floating-point numbers may differ.
        steps_per_update: environment steps of one update of the learner.
        by_level: ``steps`` are levels.

    Raises:
        InputError: no leaf differs, a leaf that cannot be interpolated does, or a leaf's shape or
            the structure does.
    """
    first, *others = trees
    structure: Any = jax.tree.structure(first)
    for other in others:
        found: Any = jax.tree.structure(other)
        if found != structure or _shapes(other) != _shapes(first):
            raise InputError(
                f"schedules: {key} cannot be scheduled: it changes the program, not only numbers"
            )
    columns = list(zip(*(_host_leaves(tree) for tree in trees), strict=True))
    changed = [i for i, c in enumerate(columns) if any(np.any(x != c[0]) for x in c[1:])]
    if not changed:
        raise InputError(f"schedules: {key} has no effect: it changes no number of this run")
    for i in changed:
        numbers = np.stack(columns[i])
        if not (np.issubdtype(numbers.dtype, np.floating) and np.all(np.isfinite(numbers))):
            raise InputError(
                f"schedules: {key} cannot be scheduled: it changes numbers that are whole or "
                "infinite, allowed: finite floating-point numbers"
            )
    knots = np.asarray(steps, np.float64) / (1 if by_level else steps_per_update)
    lengths = np.diff(knots)
    rates = np.divide(1.0, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    return Knots(
        knots=jnp.asarray(knots, jnp.float32),
        rates=jnp.asarray(rates, jnp.float32),
        values=tuple(jnp.asarray(np.stack(columns[i])) for i in changed),
        leaves=tuple(changed),
        by_level=by_level,
    )


def schedule_learner(
    learner: Learner,
    schedules: Mapping[str, Schedule],
    numbers_at: Callable[[str, float | None], Tree],
    steps: int,
    total: int,
    curriculum: Curriculum | None = None,
) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    Args:
        learner: any learner.
        schedules: by the key of a number.
        numbers_at: ``(key, value) -> (hyperparameters, environment parameters)`` with the key set
            to a value; None keeps its own value.
        steps: requested environment steps of the run, to which fractions refer.
        total: environment steps of the run, a whole number of updates.
        curriculum: of the schedules by ``pass_rate``.

    Raises:
        InputError: a schedule without effect, or of a key that is not a number.
    """
    built = {}
    for key, schedule in schedules.items():
        trees = [numbers_at(key, None if x == "value" else x) for x in schedule.linear]
        knots = schedule.knots(steps, total)
        by_level = schedule.by == "pass_rate"
        built[key] = make_schedule(key, knots, trees, learner.steps_per_update, by_level)
    curriculum = curriculum or Curriculum()
    updates = curriculum.duration * steps / learner.steps_per_update
    climb = Climb(jnp.float32(curriculum.pass_rate), jnp.float32(1.0 / max(1.0, updates)))
    return with_schedules(learner, built, climb)


def _shapes(tree: Tree) -> list[tuple[tuple[int, ...], np.dtype]]:
    return [(np.shape(x), jnp.result_type(x)) for x in jax.tree.leaves(tree)]


def _host_leaves(tree: Tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(jax.device_get(tree))]


def interpolate(
    schedule: Knots, update: jax.Array, level: jax.Array | None = None
) -> list[jax.Array]:
    """The scheduled leaves after ``update`` () updates, or at a ``level`` ()."""
    done = level if schedule.by_level and level is not None else update.astype(jnp.float32)
    results = [values[0] for values in schedule.values]
    for i in range(schedule.knots.shape[0] - 1):
        rising = jnp.clip((done - schedule.knots[i]) * schedule.rates[i], 0.0, 1.0)
        fraction = jnp.where(done >= schedule.knots[i + 1], 1.0, rising)
        for j, values in enumerate(schedule.values):
            results[j] = results[j] + fraction * (values[i + 1] - values[i])
    return results


def apply_schedules(
    tree: Tree, schedules: Sequence[Knots], update: jax.Array, level: jax.Array | None = None
) -> Tree:
    """The pytree with its scheduled leaves as they are after ``update`` () updates."""
    leaves, structure = jax.tree.flatten(tree)
    for schedule in schedules:
        for index, value in zip(schedule.leaves, interpolate(schedule, update, level), strict=True):
            leaves[index] = value
    return jax.tree.unflatten(structure, leaves)


def with_schedules(
    learner: Learner, schedules: dict[str, Knots], climb: Climb | None = None
) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    ``init`` and ``update`` of the learner get the numbers of the first knots and of the update's
    environment steps, ``state.update * steps_per_update``.

    Args:
        learner: any learner; its ``hyper`` is a pytree of arrays.
        schedules: by the key that each of them changes.
        climb: how the level changes, where a schedule follows it.

    Returns:
        A learner whose ``hyper`` holds the schedules too: they are traced arguments.

    Raises:
        InputError: two schedules change the same number.
    """
    if not schedules:
        return learner
    _check_disjoint(schedules)

    def init(hyper: Scheduled, params: Tree, key: jax.Array) -> TrainState:
        start = jnp.zeros((), jnp.int32)
        level = None if hyper.climb is None else jnp.zeros(())
        own, params = apply_schedules((hyper.hyper, params), hyper.schedules, start, level)
        state = learner.init(own, params, key)
        return state if level is None else dataclasses.replace(state, level=level)

    def update(hyper: Scheduled, params: Tree, state: TrainState) -> tuple[TrainState, Metrics]:
        numbers, level = (hyper.hyper, params), None if hyper.climb is None else state.level
        own, params = apply_schedules(numbers, hyper.schedules, state.update, level)
        following, metrics = learner.update(own, params, state)
        if hyper.climb is None:
            return following, metrics
        level = next_level(hyper.climb, state.level, metrics)
        return dataclasses.replace(following, level=level), metrics | {"level": level}

    leveled = any(schedule.by_level for schedule in schedules.values())
    hyper = Scheduled(learner.hyper, tuple(schedules.values()), climb if leveled else None)
    return dataclasses.replace(learner, init=init, update=update, hyper=hyper)


def next_level(climb: Climb, level: jax.Array, metrics: Metrics) -> jax.Array:
    """The level after an update: it rises while enough parts of the task are completed.

    Raises:
        InputError: the learner or the environment does not report the share.
    """
    if "pass_rate" not in metrics:
        raise InputError("schedules by pass_rate: the learner reports no metric pass_rate")
    step = jnp.where(metrics["pass_rate"] >= climb.pass_rate, climb.rate, -climb.rate)
    return jnp.clip(level + step, 0.0, 1.0)


def _check_disjoint(schedules: dict[str, Knots]) -> None:
    owner: dict[int, str] = {}
    for key, schedule in schedules.items():
        for leaf in schedule.leaves:
            if leaf in owner:
                raise InputError(f"schedules: {owner[leaf]} and {key} change the same number")
            owner[leaf] = key
