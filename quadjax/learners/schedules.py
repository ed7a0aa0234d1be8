"""Schedules: numbers of a run that change during training.

A schedule is built from the run's numbers at each of its knots: the whole pytree of hyperparameters
and environment parameters, once per knot. The leaves that differ are the scheduled ones. Between
two knots they are interpolated linearly, in updates or in a level that follows the pass rate;
before the first knot they have the first value, after the last one the last. Knots and values are
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
from quadjax.learners.loop import Plan
from quadjax.learners.section import Curriculum, Schedule
from quadjax.learners.state import Learner, Metrics, TrainState

Tree = Any  # a pytree


@struct.dataclass
class Knots:
    """Values of some leaves of a pytree at each knot."""

    knots: jax.Array  # (k,) number of updates, or levels, increasing
    values: tuple[jax.Array, ...]  # (k, *shape of the leaf), one for each scheduled leaf
    leaves: tuple[int, ...] = struct.field(pytree_node=False)  # their indices in the flat pytree
    by_level: bool = struct.field(pytree_node=False, default=False)  # else by updates


@struct.dataclass
class Scheduled:
    """Hyperparameters of a learner together with the schedules of the run."""

    hyper: Tree
    schedules: tuple[Knots, ...]
    pass_rate: jax.Array | None = None  # () at which the level rises; None: there is no level
    climb: jax.Array | None = None  # () largest change of the level per update


def make_schedule(
    key: str, knots: np.ndarray, trees: Sequence[Tree], by_level: bool = False
) -> Knots:
    """A schedule from the run's numbers at each knot.

    Args:
        key: what is scheduled, for error messages.
        knots: updates, or levels, not decreasing; at two equal ones the value jumps.
        trees: ``(hyperparameters, environment parameters)`` at each knot, of one structure. Only
            leaves of floating-point numbers may differ.
        by_level: the knots are levels.

    Raises:
        InputError: no leaf differs, a leaf that cannot be interpolated does, or a leaf's shape or
            the structure does.
    """

    def program(tree: Tree) -> tuple:
        """What has to be the same at every knot."""
        leaves, structure = jax.tree.flatten(tree)
        return structure, [(np.shape(x), jnp.result_type(x)) for x in leaves]

    if any(program(tree) != program(trees[0]) for tree in trees[1:]):
        raise InputError(
            f"schedules: {key} cannot be scheduled: it changes the program, not only numbers"
        )
    rows = zip(*(jax.tree.leaves(jax.device_get(tree)) for tree in trees), strict=True)
    columns = {i: np.stack([np.asarray(x) for x in row]) for i, row in enumerate(rows)}
    changed = {i: column for i, column in columns.items() if np.any(column != column[:1])}
    if not changed:
        raise InputError(f"schedules: {key} has no effect: it changes no number of this run")
    for column in changed.values():
        if not (np.issubdtype(column.dtype, np.floating) and np.all(np.isfinite(column))):
            raise InputError(
                f"schedules: {key} cannot be scheduled: it changes numbers that are whole or "
                "infinite, allowed: finite floating-point numbers"
            )
    values = tuple(jnp.asarray(column) for column in changed.values())
    return Knots(jnp.asarray(_increasing(knots)), values, tuple(changed), by_level)


def _increasing(knots: np.ndarray) -> np.ndarray:
    """The knots in single precision; of equal ones, the earlier are moved to smaller numbers."""
    knots = knots.astype(np.float32)
    for i in range(len(knots) - 2, -1, -1):
        knots[i] = min(knots[i], np.nextafter(knots[i + 1], np.float32(-np.inf)))
    return knots


def schedule_learner(
    learner: Learner,
    schedules: Mapping[str, Schedule],
    numbers_at: Callable[[str, float | None], Tree],
    plan: Plan,
    steps: int,
    curriculum: Curriculum | None = None,
) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    ``init`` and ``update`` of the learner get the numbers of the first knots and of the update.

    Args:
        learner: any learner; its ``hyper`` is a pytree of arrays.
        schedules: by the key of a number.
        numbers_at: ``(key, value) -> (hyperparameters, environment parameters)`` with the key set
            to a value; None keeps its present value.
        plan: of the run.
        steps: requested environment steps of the run, to which fractions refer.
        curriculum: how the level changes, where a schedule follows it.

    Returns:
        A learner whose ``hyper`` holds the schedules too: they are traced arguments.

    Raises:
        InputError: a schedule without effect, of a key that is not a number, or of a number that
            another one changes too.
    """
    if not schedules:
        return learner
    built: list[Knots] = []
    keys: dict[int, str] = {}  # of the schedule of each leaf
    for key, schedule in schedules.items():
        trees = [numbers_at(key, None if x == "value" else x) for x in schedule.linear]
        by_level = schedule.by == "pass_rate"
        knots = np.array(schedule.knots(steps, plan.steps))
        knots = knots if by_level else knots / plan.steps_per_update
        built.append(make_schedule(key, knots, trees, by_level))
        for leaf in built[-1].leaves:
            if (other := keys.setdefault(leaf, key)) != key:
                raise InputError(f"schedules: {other} and {key} change the same number")
    hyper = Scheduled(learner.hyper, tuple(built))
    if any(knots.by_level for knots in built):
        curriculum = curriculum or Curriculum()
        updates = max(1.0, curriculum.duration * steps / plan.steps_per_update)
        pass_rate, climb = jnp.float32(curriculum.pass_rate), jnp.float32(1.0 / updates)
        hyper = dataclasses.replace(hyper, pass_rate=pass_rate, climb=climb)
    return _scheduled(learner, hyper)


def _scheduled(learner: Learner, hyper: Scheduled) -> Learner:
    """The learner that applies the schedules of its hyperparameters."""

    def init(hyper: Scheduled, params: Tree, key: jax.Array) -> TrainState:
        level, first = jnp.zeros(()), jnp.zeros((), jnp.int32)
        numbers, params = apply_schedules((hyper.hyper, params), hyper.schedules, first, level)
        state = learner.init(numbers, params, key)
        return state if hyper.climb is None else dataclasses.replace(state, level=level)

    def update(hyper: Scheduled, params: Tree, state: TrainState) -> tuple[TrainState, Metrics]:
        level = None if hyper.climb is None else state.level
        numbers, params = apply_schedules(
            (hyper.hyper, params), hyper.schedules, state.update, level
        )
        following, metrics = learner.update(numbers, params, state)
        if hyper.pass_rate is None or hyper.climb is None:
            return following, metrics
        level = next_level(state.level, metrics, hyper.pass_rate, hyper.climb)
        return dataclasses.replace(following, level=level), metrics | {"level": level}

    return dataclasses.replace(learner, init=init, update=update, hyper=hyper)


def apply_schedules(
    tree: Tree, schedules: Sequence[Knots], update: jax.Array, level: jax.Array | None = None
) -> Tree:
    """The pytree with its scheduled leaves as they are after ``update`` () updates."""
    leaves, structure = jax.tree.flatten(tree)
    for schedule in schedules:
        count = schedule.knots.shape[0]
        place = level if schedule.by_level and level is not None else update.astype(jnp.float32)
        shares = jax.vmap(jnp.interp, (None, None, 0))(place, schedule.knots, jnp.eye(count))
        for index, values in zip(schedule.leaves, schedule.values, strict=True):
            weights = shares.reshape(count, *(1,) * (values.ndim - 1)).astype(values.dtype)
            leaves[index] = jnp.sum(weights * values, axis=0)
    return jax.tree.unflatten(structure, leaves)


def next_level(
    level: jax.Array, metrics: Metrics, pass_rate: jax.Array, climb: jax.Array
) -> jax.Array:
    """The level after an update: it rises while enough parts of the task are completed.

    Raises:
        InputError: the learner or the environment does not report the share.
    """
    if "pass_rate" not in metrics:
        raise InputError("schedules by pass_rate: the learner reports no metric pass_rate")
    step = jnp.where(metrics["pass_rate"] >= pass_rate, climb, -climb)
    return jnp.clip(level + step, 0.0, 1.0)
