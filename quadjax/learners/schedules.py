"""Schedules: numbers of a run that change during training.

A schedule names leaves of a run by their paths: of ``learner``, the hyperparameters, or of
``params``, the environment's parameters. Between two knots their value is interpolated linearly, in
updates or in a level that follows the pass rate; before the first knot it is the first value, after
the last one the last. Knots and values are traced: other numbers for the same leaves do not trigger
recompilation.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError, close_match
from quadjax.core.sections import LARGEST, Field, Section
from quadjax.learners.loop import Plan
from quadjax.learners.state import Metrics, Task, TrainState

if TYPE_CHECKING:
    from quadjax.learners.learner import Learner

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
    """Values of one leaf of a run at each knot."""

    knots: jax.Array  # (k,) number of updates, or levels, increasing
    values: jax.Array  # (k, *shape of the leaf)
    path: str = struct.field(pytree_node=False)
    by_level: bool = struct.field(pytree_node=False)  # else by updates


class Training(struct.PyTreeNode):
    """A learner, its task, and the schedules of their numbers: what a run compiles and repeats."""

    learner: "Learner"
    task: Task
    schedules: tuple[Knots, ...] = ()
    # () share at which the level rises, and its largest change per update; None: no level.
    curriculum: tuple[jax.Array, jax.Array] | None = None

    def at(self, update: jax.Array, level: jax.Array | None = None) -> tuple["Learner", Task]:
        """Learner and task with the numbers after ``update`` () updates, or at a level ()."""
        leaves, structure = _leaves(self)
        for schedule in self.schedules:
            place = update.astype(jnp.float32)
            if schedule.by_level and level is not None:
                place = level
            count, values = schedule.knots.shape[0], schedule.values
            shares = jax.vmap(jnp.interp, (None, None, 0))(place, schedule.knots, jnp.eye(count))
            weights = shares.reshape(count, *(1,) * (values.ndim - 1)).astype(values.dtype)
            leaves[schedule.path] = jnp.sum(weights * values, axis=0)
        found = jax.tree.unflatten(structure, leaves.values())
        return found["learner"], self.task.replace(env_params=found["params"])

    def init(self, key: jax.Array) -> TrainState:
        """The first state of a run."""
        learner, task = self.at(jnp.zeros((), jnp.int32), jnp.zeros(()))
        state = learner.init(task, key)
        if self.curriculum is None:
            return state
        return dataclasses.replace(state, level=jnp.zeros(()))

    def update(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """The state after one update, and its metrics."""
        learner, task = self.at(state.update, state.level)
        next_state, metrics = learner.update(task, state)
        if self.curriculum is None:
            return next_state, metrics
        if "pass_rate" not in metrics:
            raise InputError("schedules by pass_rate: the learner reports no metric pass_rate")
        pass_rate, climb = self.curriculum  # the level rises while enough parts are completed
        step = jnp.where(metrics["pass_rate"] >= pass_rate, climb, -climb)
        level = jnp.clip(state.level + step, 0.0, 1.0)
        return dataclasses.replace(next_state, level=level), metrics | {"level": level}

    def with_schedules(
        self,
        schedules: Mapping[str, Schedule],
        paths: Callable[[str], tuple[str, ...]],
        plan: Plan,
        steps: int,
        curriculum: Curriculum | None = None,
    ) -> "Training":
        """The training with numbers that follow schedules.

        Args:
            schedules: by key.
            paths: the paths of the leaves that a key sets.
            plan: of the run.
            steps: requested environment steps of the run, to which fractions refer.
            curriculum: how the level changes.

        Raises:
            InputError: a schedule of a key that sets no leaf, of a number that is whole or
                infinite, from which others are computed, or of one that another schedule changes.
        """
        leaves, keys, built = _leaves(self)[0], dict[str, str](), []
        for key, schedule in schedules.items():
            if needs := self.task.environments.describe_dependents(self.task.env_params, key):
                raise InputError(f"schedules: {key} cannot be scheduled: {needs} computed from it")
            for path in paths(key):
                if (other := keys.setdefault(path, key)) != key:
                    raise InputError(f"schedules: {other} and {key} change the same number")
                built.append(_make_knots(key, path, schedule, leaves, plan, steps))
        limits = None
        if any(knots.by_level for knots in built):
            curriculum = curriculum or Curriculum()
            updates = max(1.0, curriculum.duration * steps / plan.steps_per_update)
            limits = jnp.float32(curriculum.pass_rate), jnp.float32(1.0 / updates)
        return self.replace(schedules=tuple(built), curriculum=limits)


def _leaves(training: Training) -> tuple[dict[str, Any], Any]:
    """The leaves of a run by their paths, in order, and the structure that they fill."""
    tree = {"learner": training.learner, "params": training.task.env_params}
    pairs, structure = jax.tree_util.tree_flatten_with_path(tree)
    text = jax.tree_util.keystr
    return {text(path, simple=True, separator="."): leaf for path, leaf in pairs}, structure


def _make_knots(
    key: str, path: str, schedule: Schedule, leaves: Mapping[str, Any], plan: Plan, steps: int
) -> Knots:
    """The values of a leaf at the knots; at two equal knots the value jumps."""
    own = np.asarray(leaves.get(path, np.nan))
    if not (np.issubdtype(own.dtype, np.floating) and np.all(np.isfinite(own))):
        names = [name.removeprefix("params.").removeprefix("learner.") for name in leaves]
        raise InputError(
            f"schedules: {key} cannot be scheduled, allowed: a finite floating-point number of the "
            f"learner or of the environment's params{close_match(key, names, 3)}"
        )
    values = [own if x == "value" else np.full_like(own, x) for x in schedule.linear]
    if np.array_equal(values, [own] * len(values)):
        raise InputError(f"schedules: {key} has no effect: it changes no number of this run")
    by_level, places = schedule.by == "pass_rate", np.array(schedule.knots(steps, plan.steps))
    places = (places if by_level else places / plan.steps_per_update).astype(np.float32)
    for i in range(len(places) - 2, -1, -1):  # of equal ones, the earlier get smaller numbers
        places[i] = min(places[i], np.nextafter(places[i + 1], np.float32(-np.inf)))
    return Knots(jnp.asarray(places), jnp.asarray(np.stack(values)), path, by_level)
