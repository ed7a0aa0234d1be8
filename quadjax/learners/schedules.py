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
from quadjax.learners.section import Schedule
from quadjax.learners.state import Learner, Metrics, TrainState

Tree = Any  # a pytree


@struct.dataclass
class Knots:
    """Values of some leaves of a pytree at each knot."""

    knots: jax.Array  # (k,) number of updates, not decreasing
    rates: jax.Array  # (k - 1,) 1 / (number of updates between two knots); 0 if there are none
    values: tuple[jax.Array, ...]  # (k, *shape of the leaf), one for each scheduled leaf
    leaves: tuple[int, ...] = struct.field(pytree_node=False)  # their indices in the flat pytree


@struct.dataclass
class Scheduled:
    """Hyperparameters of a learner together with the schedules of the run."""

    hyper: Tree
    schedules: tuple[Knots, ...]


def make_schedule(
    key: str, steps: Sequence[float], trees: Sequence[Tree], steps_per_update: int
) -> Knots:
    """A schedule from the run's numbers at each knot.

    Args:
        key: what is scheduled, for error messages.
        steps: environment steps at each knot, not decreasing.
        trees: ``(hyperparameters, environment parameters)`` at each knot, of one structure. Only
            leaves of floating-point numbers may differ.
        steps_per_update: environment steps of one update of the learner.

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
    knots = np.asarray(steps, np.float64) / steps_per_update
    lengths = np.diff(knots)
    rates = np.divide(1.0, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    return Knots(
        knots=jnp.asarray(knots, jnp.float32),
        rates=jnp.asarray(rates, jnp.float32),
        values=tuple(jnp.asarray(np.stack(columns[i])) for i in changed),
        leaves=tuple(changed),
    )


def schedule_learner(
    learner: Learner,
    schedules: Mapping[str, Schedule],
    numbers_at: Callable[[str, float | None], Tree],
    steps: int,
    total: int,
) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    Args:
        learner: any learner.
        schedules: by the key of a number.
        numbers_at: ``(key, value) -> (hyperparameters, environment parameters)`` with the key set
            to a value; None keeps its own value.
        steps: requested environment steps of the run, to which fractions refer.
        total: environment steps of the run, a whole number of updates.

    Raises:
        InputError: a schedule without effect, or of a key that is not a number.
    """
    built = {}
    for key, schedule in schedules.items():
        trees = [numbers_at(key, None if x == "value" else x) for x in schedule.linear]
        knots = schedule.knots(steps, total)
        built[key] = make_schedule(key, knots, trees, learner.steps_per_update)
    return with_schedules(learner, built)


def _shapes(tree: Tree) -> list[tuple[tuple[int, ...], np.dtype]]:
    return [(np.shape(x), jnp.result_type(x)) for x in jax.tree.leaves(tree)]


def _host_leaves(tree: Tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(jax.device_get(tree))]


def interpolate(schedule: Knots, update: jax.Array) -> list[jax.Array]:
    """The scheduled leaves after ``update`` () updates."""
    done = update.astype(jnp.float32)
    results = [values[0] for values in schedule.values]
    for i in range(schedule.knots.shape[0] - 1):
        rising = jnp.clip((done - schedule.knots[i]) * schedule.rates[i], 0.0, 1.0)
        fraction = jnp.where(done >= schedule.knots[i + 1], 1.0, rising)
        for j, values in enumerate(schedule.values):
            results[j] = results[j] + fraction * (values[i + 1] - values[i])
    return results


def apply_schedules(tree: Tree, schedules: Sequence[Knots], update: jax.Array) -> Tree:
    """The pytree with its scheduled leaves as they are after ``update`` () updates."""
    leaves, structure = jax.tree.flatten(tree)
    for schedule in schedules:
        for index, value in zip(schedule.leaves, interpolate(schedule, update), strict=True):
            leaves[index] = value
    return jax.tree.unflatten(structure, leaves)


def with_schedules(learner: Learner, schedules: dict[str, Knots]) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    ``init`` and ``update`` of the learner get the numbers of the first knots and of the update's
    environment steps, ``state.update * steps_per_update``.

    Args:
        learner: any learner; its ``hyper`` is a pytree of arrays.
        schedules: by the key that each of them changes.

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
        own, params = apply_schedules((hyper.hyper, params), hyper.schedules, start)
        return learner.init(own, params, key)

    def update(hyper: Scheduled, params: Tree, state: TrainState) -> tuple[TrainState, Metrics]:
        own, params = apply_schedules((hyper.hyper, params), hyper.schedules, state.update)
        return learner.update(own, params, state)

    hyper = Scheduled(learner.hyper, tuple(schedules.values()))
    return dataclasses.replace(learner, init=init, update=update, hyper=hyper)


def _check_disjoint(schedules: dict[str, Knots]) -> None:
    owner: dict[int, str] = {}
    for key, schedule in schedules.items():
        for leaf in schedule.leaves:
            if leaf in owner:
                raise InputError(f"schedules: {owner[leaf]} and {key} change the same number")
            owner[leaf] = key
