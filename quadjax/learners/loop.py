"""The host's loop over compiled chunks: score, report, save, stop. Every learner shares it."""

import dataclasses
import math
import time
from collections.abc import Callable

import jax
import numpy as np

from quadjax.learners.networks import ActorCritic
from quadjax.learners.sharding import Chunk
from quadjax.learners.state import TrainState

Row = dict[str, float]


class NonFiniteError(RuntimeError):
    """Training met a number that is not finite; says where."""


@dataclasses.dataclass
class Position:
    """Where a run is: what a checkpoint holds."""

    state: TrainState
    best: ActorCritic  # the parameters of the best score so far; the latest before the first
    best_score: float = math.inf
    best_steps: int = 0
    chunks: int = 0
    seconds: float = 0.0  # of training, over all resumptions


@dataclasses.dataclass(frozen=True)
class Hooks:
    """What happens between chunks."""

    score: Callable[[ActorCritic], float]  # lower is better; infinite where it does not finish
    report: Callable[[Row], None]
    save: Callable[[Position], None]
    stop: Callable[[], bool]
    agree: Callable[[bool], bool] = bool  # of all processes: whether any says so


def run(
    chunk: Chunk,
    params: object,
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
        position: where to begin.
        hooks: what to do between chunks.
        chunks: in the whole run.
        steps_per_chunk: environment steps of one.
        save_seconds: at least so long between two checkpoints.
        started: ``time.monotonic()`` at which ``position.seconds`` counts as zero.

    Raises:
        NonFiniteError: a metric that is not finite; the last checkpoint stays as it is.
    """
    saved = time.monotonic()
    while position.chunks < chunks and not hooks.agree(hooks.stop()):
        begun = time.monotonic()
        state, metrics = chunk(params, position.state)
        values = {name: np.asarray(value) for name, value in metrics.items()}
        check_finite(values, position.chunks * len(next(iter(values.values()))))
        took = time.monotonic() - begun
        score = hooks.score(state.flown)
        position = advance(position, state, score, steps_per_chunk, time.monotonic() - started)
        hooks.report(row_of(position, values, score, steps_per_chunk, took))
        due = hooks.agree(time.monotonic() - saved > save_seconds)
        if due and position.chunks < chunks:
            hooks.save(position)
            saved = time.monotonic()
    hooks.save(position)
    return position


def advance(
    position: Position, state: TrainState, score: float, steps: int, seconds: float
) -> Position:
    """The position one chunk later, with the best parameters kept on the host.

    Of equal scores the later one counts as better: it has trained for longer.
    """
    following = dataclasses.replace(
        position, state=state, chunks=position.chunks + 1, seconds=seconds
    )
    if score <= position.best_score or not math.isfinite(position.best_score):
        following.best = jax.device_get(state.flown)
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
            "checkpoint is from before"
        )


def row_of(
    position: Position, values: dict[str, np.ndarray], score: float, steps: int, took: float
) -> Row:
    """One chunk's row of metrics.

    Args:
        position: after the chunk.
        values: metrics of the chunk's updates, (updates,) each.
        score: of the policy now.
        steps: of the chunk.
        took: seconds of the chunk.
    """
    return {
        "steps": position.chunks * steps,
        "seconds": position.seconds,
        "steps_per_second": steps / took,
        "score": score,
        "best_score": position.best_score,
        **{name: float(value.mean()) for name, value in values.items()},
    }
