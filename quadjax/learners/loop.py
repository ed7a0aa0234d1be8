"""The loop over compiled chunks of updates: score, report, save, stop. All learners use it."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from quadjax.learners.networks import ActorCritic
from quadjax.learners.sharding import Chunk
from quadjax.learners.state import TrainState

Row = dict[str, float]


class NonFiniteError(RuntimeError):
    """A metric of training is not finite; the message says which, and at which update."""


@dataclasses.dataclass
class Position:
    """The progress of a run: what a checkpoint holds."""

    state: TrainState
    best: ActorCritic  # the parameters of the best score so far; the latest before the first
    best_score: float = math.inf
    best_steps: int = 0
    chunks: int = 0
    seconds: float = 0.0  # of training, summed over all times that the run was resumed


def plan_chunks(steps: int, steps_per_chunk: int, steps_per_update: int) -> tuple[int, int]:
    """Updates of one chunk, and chunks of a run: whole numbers, each at least one.

    Args:
        steps: environment steps of the run; the plan differs by at most half an update per chunk.
        steps_per_chunk: environment steps of a chunk, about: chunks divide the run evenly.
        steps_per_update: environment steps of an update.
    """
    wanted = max(1, round(steps / steps_per_update))
    chunks = max(1, round(wanted / max(1, round(steps_per_chunk / steps_per_update))))
    return round(wanted / chunks), chunks


@dataclasses.dataclass(frozen=True)
class Hooks:
    """The functions that are called between chunks."""

    score: Callable[[ActorCritic], float]  # lower is better; infinite where it does not finish
    report: Callable[[Row], None]
    save: Callable[[Position], None]
    stop: Callable[[], bool]


def run(
    chunk: Chunk,
    params: Any,
    position: Position,
    hooks: Hooks,
    chunks: int,
    steps_per_chunk: int,
    save_seconds: float,
    started: float,
) -> Position:
    """Train until ``chunks`` chunks are done or ``hooks.stop`` says so, then save.

    Args:
        chunk: a compiled chunk of updates.
        params: traced parameters of the environment.
        position: where to start.
        hooks: called between chunks.
        chunks: in the whole run.
        steps_per_chunk: environment steps of one.
        save_seconds: minimum time between two checkpoints, s.
        started: ``time.monotonic()`` at which ``position.seconds`` counts as zero.

    Raises:
        NonFiniteError: a metric is not finite. No checkpoint is written after that.
    """
    saved = time.monotonic()
    while position.chunks < chunks and not hooks.stop():
        chunk_started = time.monotonic()
        state, metrics = chunk(params, position.state)
        values = {name: np.asarray(value) for name, value in metrics.items()}
        check_finite(values, position.chunks * len(next(iter(values.values()))))
        took = time.monotonic() - chunk_started
        score = hooks.score(state.evaluated)
        position = advance(position, state, score, steps_per_chunk, time.monotonic() - started)
        hooks.report(row_of(position, values, score, steps_per_chunk, took))
        due = time.monotonic() - saved > save_seconds
        if due and position.chunks < chunks:
            hooks.save(position)
            saved = time.monotonic()
    hooks.save(position)
    return position


def advance(
    position: Position, state: TrainState, score: float, steps: int, seconds: float
) -> Position:
    """The position one chunk later, with the best parameters kept on the host.

    Of equal scores the later one counts as better.
    """
    following = dataclasses.replace(
        position, state=state, chunks=position.chunks + 1, seconds=seconds
    )
    if score <= position.best_score or not math.isfinite(position.best_score):
        following.best = jax.device_get(state.evaluated)
        following.best_score = score
        following.best_steps = following.chunks * steps
    return following


def check_finite(metrics: dict[str, np.ndarray], first_update: int) -> None:
    """Raise a ``NonFiniteError`` that names the update and the metrics."""
    bad = {name: np.flatnonzero(~np.isfinite(value)) for name, value in metrics.items()}
    bad = {name: index for name, index in bad.items() if index.size}
    if bad:
        where = min(int(index[0]) for index in bad.values())
        names = ", ".join(sorted(name for name, index in bad.items() if index[0] == where))
        raise NonFiniteError(
            f"not finite at update {first_update + where + 1}: {names}; training stopped, and any "
            "checkpoint is from an earlier update"
        )


def row_of(
    position: Position, values: dict[str, np.ndarray], score: float, steps: int, took: float
) -> Row:
    """One chunk's row of metrics.

    Args:
        position: after the chunk.
        values: metrics of the chunk's updates, (updates,) each.
        score: of the current policy.
        steps: of the chunk.
        took: duration of the chunk, s.
    """
    return {
        "steps": position.chunks * steps,
        "seconds": position.seconds,
        "steps_per_second": steps / took,
        "score": score,
        "best_score": position.best_score,
        **{name: float(value.mean()) for name, value in values.items()},
    }
