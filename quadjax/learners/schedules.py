"""Schedules: numbers of a run that change during training.

A schedule is built from the run's numbers at each of its knots: the whole pytree of hyperparameters
and environment parameters, once per knot. The leaves that differ are the scheduled ones. Between
two knots they are interpolated linearly, in updates or in a level that follows the pass rate;
before the first knot they have the first value, after the last one the last. Knots and values are
traced: other numbers for the same leaves do not trigger recompilation.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.sections import LARGEST, Field, Section
from quadjax.learners.loop import Plan
from quadjax.learners.state import Learner, Metrics, TrainState, Update

Tree = Any  # a pytree
Value = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class Curriculum(Section):
    """The level that schedules with ``by: pass_rate`` follow: from 0, the start, to 1."""

    pass_rate: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="the level rises while at least this share of gates is passed: gates passed, "
        "divided by gates passed and crashes (and finished courses)",
    )
    duration: float = Field(
        0.25, gt=0, le=1, description="shortest time from level 0 to 1, as a fraction of the run"
    )


class Schedule(Section):
    """Values of one number during training: a hyperparameter, or one of the environment."""

    linear: tuple[Value | Literal["value"], ...] = Field(
        min_length=2,
        max_length=64,
        description="values at equal distances, linear in between; value: the key's own",
    )
    start: float = Field(
        0.0,
        alias="from",
        ge=0,
        le=1e12,
        description="when the first value ends: up to 1 a fraction of the run, above 1 steps",
    )
    until: float = Field(
        1.0, gt=0, le=1e12, description="when the last value is reached: as from; 1 is the end"
    )
    by: Literal["steps", "pass_rate"] = Field(
        "steps",
        description="what the schedule follows: the steps of the run, or a level from 0 to 1 that "
        "rises while the share of gates passed is above curriculum.pass_rate, and falls while it "
        "is below",
    )

    def knots(self, run_steps: int, total: int) -> list[float]:
        """Environment steps, or levels, of the values; ``total`` steps are the end of the run."""
        begin, end = self.start, self.until
        if self.by == "steps":
            begin, end = (
                float(total) if x == 1 else x if x > 1 else min(x * run_steps, total)
                for x in (begin, end)
            )
        last = len(self.linear) - 1
        return [begin + (end - begin) * i / last for i in range(last + 1)]


class Knots(struct.PyTreeNode):
    """Values of some leaves of a pytree at each knot."""

    knots: jax.Array  # (k,) number of updates, or levels, increasing
    values: tuple[jax.Array, ...]  # (k, *shape of the leaf), one for each scheduled leaf
    leaves: tuple[int, ...] = struct.field(pytree_node=False)  # their indices in the flat pytree
    by_level: bool = struct.field(pytree_node=False, default=False)  # else by updates


class Scheduled(struct.PyTreeNode):
    """Hyperparameters of a learner together with the schedules of the run."""

    hyper: Tree
    schedules: tuple[Knots, ...]
    # () share at which the level rises, and its largest change per update; None: no level.
    curriculum: tuple[jax.Array, jax.Array] | None = None

    def at(self, update: jax.Array, level: jax.Array | None, params: Tree) -> tuple[Tree, Tree]:
        """The hyperparameters and the environment's parameters after ``update`` () updates."""
        leaves, structure = jax.tree.flatten((self.hyper, params))
        for schedule in self.schedules:
            count = schedule.knots.shape[0]
            place = level if schedule.by_level and level is not None else update.astype(jnp.float32)
            shares = jax.vmap(jnp.interp, (None, None, 0))(place, schedule.knots, jnp.eye(count))
            for index, values in zip(schedule.leaves, schedule.values, strict=True):
                weights = shares.reshape(count, *(1,) * (values.ndim - 1)).astype(values.dtype)
                leaves[index] = jnp.sum(weights * values, axis=0)
        return jax.tree.unflatten(structure, leaves)


def make_schedule(
    key: str, knots: np.ndarray, trees: Sequence[Tree], by_level: bool = False
) -> Knots:
    """A schedule of a key from the run's numbers at each knot.

    Knots are updates or levels, not decreasing; at two equal ones the value jumps. ``trees`` are
    ``(hyperparameters, environment parameters)`` at each knot.

    Raises:
        InputError: no leaf differs, a leaf that cannot be interpolated does, or a leaf's shape or
            the structure does.
    """

    def program(tree: Tree) -> tuple:
        """What has to be the same at every knot."""
        leaves, structure = jax.tree.flatten(tree)
        return structure, [(np.shape(x), jnp.result_type(x)) for x in leaves]

    def refuse(reason: str) -> NoReturn:
        raise InputError(f"schedules: {key} {reason}")

    if any(program(tree) != program(trees[0]) for tree in trees[1:]):
        refuse("cannot be scheduled: it changes the program, not only numbers")
    rows = zip(*(jax.tree.leaves(jax.device_get(tree)) for tree in trees), strict=True)
    columns = {i: np.stack([np.asarray(x) for x in row]) for i, row in enumerate(rows)}
    changed = {i: column for i, column in columns.items() if np.any(column != column[:1])}
    if not changed:
        refuse("has no effect: it changes no number of this run")
    for column in changed.values():
        if not (np.issubdtype(column.dtype, np.floating) and np.all(np.isfinite(column))):
            refuse(
                "cannot be scheduled: it changes numbers that are whole or infinite, allowed: "
                "finite floating-point numbers"
            )
    places = knots.astype(np.float32)
    for i in range(len(places) - 2, -1, -1):  # of equal ones, the earlier get smaller numbers
        places[i] = min(places[i], np.nextafter(places[i + 1], np.float32(-np.inf)))
    values = tuple(jnp.asarray(column) for column in changed.values())
    return Knots(jnp.asarray(places), values, tuple(changed), by_level)


def schedule_learner(
    learner: Learner,
    schedules: Mapping[str, Schedule],
    numbers_at: Callable[[str, float | None], Tree],
    plan: Plan,
    steps: int,
    curriculum: Curriculum | None = None,
) -> Learner:
    """The learner with hyperparameters and environment parameters that follow schedules.

    ``init`` and ``update`` of the learner get the numbers of the first knots and of the update. Its
    ``hyper`` then holds the schedules too: they are traced arguments. ``numbers_at(key, value)``
    gives hyperparameters and environment parameters with another value of a key; None keeps its
    present one. Fractions of schedules refer to ``steps``, the requested environment steps of the
    run.

    Raises:
        InputError: a schedule without effect, of a key that is not a number, or of a number that
            another one changes too.
    """
    if not schedules:
        return learner
    built = _make_schedules(schedules, numbers_at, plan, steps)
    limits = None
    if any(knots.by_level for knots in built):
        curriculum = curriculum or Curriculum()
        updates = max(1.0, curriculum.duration * steps / plan.steps_per_update)
        limits = jnp.float32(curriculum.pass_rate), jnp.float32(1.0 / updates)

    hyper = Scheduled(learner.hyper, built, limits)
    init, update = _scheduled(learner.init, learner.update)
    return dataclasses.replace(learner, init=init, update=update, hyper=hyper)


@functools.lru_cache(maxsize=8)
def _scheduled(
    learner_init: Callable[[Tree, Tree, jax.Array], TrainState], learner_update: Update
) -> tuple[Callable[[Scheduled, Tree, jax.Array], TrainState], Update]:
    """``init`` and ``update`` of a learner whose numbers follow schedules."""

    def init(hyper: Scheduled, params: Tree, key: jax.Array) -> TrainState:
        first, lowest = jnp.zeros((), jnp.int32), jnp.zeros(())
        state = learner_init(*hyper.at(first, lowest, params), key)
        return state if hyper.curriculum is None else dataclasses.replace(state, level=lowest)

    def update(hyper: Scheduled, params: Tree, state: TrainState) -> tuple[TrainState, Metrics]:
        level = None if hyper.curriculum is None else state.level
        following, metrics = learner_update(*hyper.at(state.update, level, params), state)
        if hyper.curriculum is None:
            return following, metrics
        if "pass_rate" not in metrics:
            raise InputError("schedules by pass_rate: the learner reports no metric pass_rate")
        pass_rate, climb = hyper.curriculum  # the level rises while enough parts are completed
        step = jnp.where(metrics["pass_rate"] >= pass_rate, climb, -climb)
        level = jnp.clip(state.level + step, 0.0, 1.0)
        return dataclasses.replace(following, level=level), metrics | {"level": level}

    return init, update


def _make_schedules(
    schedules: Mapping[str, Schedule],
    numbers_at: Callable[[str, float | None], Tree],
    plan: Plan,
    steps: int,
) -> tuple[Knots, ...]:
    """The knots of all schedules.

    Raises:
        InputError: two schedules that change the same number.
    """
    built: list[Knots] = []
    keys: dict[int, str] = {}  # of the schedule of each leaf
    for key, schedule in schedules.items():
        trees = [numbers_at(key, None if x == "value" else x) for x in schedule.linear]
        by_level, knots = schedule.by == "pass_rate", np.array(schedule.knots(steps, plan.steps))
        knots = knots if by_level else knots / plan.steps_per_update
        built.append(make_schedule(key, knots, trees, by_level))
        for leaf in built[-1].leaves:
            if (other := keys.setdefault(leaf, key)) != key:
                raise InputError(f"schedules: {other} and {key} change the same number")
    return tuple(built)
