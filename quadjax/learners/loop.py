"""The training loop: compiled chunks of updates, one after another. All learners use it."""

import dataclasses
import math
import time
from collections.abc import Iterator

import numpy as np

from quadjax.learners.parallel import Chunk
from quadjax.learners.state import TrainState

Row = dict[str, float]


class NonFiniteError(RuntimeError):
    """A metric of training is not finite; the message says which, and at which update."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """How the updates of a run are divided into compiled chunks."""

    updates_per_chunk: int
    chunks: int  # of the run
    steps_per_update: int  # environment steps

    @property
    def updates(self) -> int:
        """Updates of the run."""
        return self.chunks * self.updates_per_chunk

    @property
    def steps_per_chunk(self) -> int:
        """Environment steps of a chunk."""
        return self.updates_per_chunk * self.steps_per_update

    @property
    def steps(self) -> int:
        """Environment steps of the run."""
        return self.chunks * self.steps_per_chunk


def plan_chunks(steps: int, steps_per_chunk: int, steps_per_update: int) -> Plan:
    """Whole updates of a chunk, and whole chunks of a run, at least one of each.

    The numbers are environment steps. A run has at least ``steps``, and less than one chunk more; a
    chunk has about ``steps_per_chunk``, so that chunks divide the run evenly.
    """
    wanted = math.ceil(steps / steps_per_update)
    chunks = max(1, round(wanted / max(1, round(steps_per_chunk / steps_per_update))))
    updates = math.ceil(wanted / chunks)
    return Plan(updates, math.ceil(wanted / updates), steps_per_update)


@dataclasses.dataclass(frozen=True)
class ChunkResult:
    """A run after a chunk of updates."""

    state: TrainState
    steps: int  # environment steps of the run that are done
    metrics: dict[str, np.ndarray]  # (updates,) each, of this chunk
    steps_per_second: float  # of this chunk

    @property
    def row(self) -> Row:
        """The chunk as one row: environment steps so far, speed, and the means of its metrics."""
        means = {name: float(value.mean()) for name, value in self.metrics.items()}
        return {"steps": self.steps, "steps_per_second": self.steps_per_second, **means}


def train_chunks(
    chunk: Chunk, state: TrainState, plan: Plan, done: int = 0
) -> Iterator[ChunkResult]:
    """Train to the end of the plan, and yield the run after each chunk.

    The memory of an earlier state is reused: only the latest one may be read. ``done`` are the
    environment steps of the run that led to ``state``: whole chunks.

    Raises:
        NonFiniteError: a metric is not finite; that chunk is not yielded.
    """
    for steps in range(done, plan.steps, plan.steps_per_chunk):
        started = time.monotonic()
        state, metrics = chunk(state)
        values = {name: np.asarray(value) for name, value in metrics.items()}
        check_finite(values, steps // plan.steps_per_update)
        speed = plan.steps_per_chunk / (time.monotonic() - started)
        yield ChunkResult(state, steps + plan.steps_per_chunk, values, speed)


def check_finite(metrics: dict[str, np.ndarray], first_update: int) -> None:
    """Raise a ``NonFiniteError`` that names the update and the metrics."""
    bad = np.array([~np.isfinite(value) for value in metrics.values()])  # (metrics, updates)
    if bad.any():
        where = int(bad.any(axis=0).argmax())
        names = ", ".join(
            sorted(name for name, row in zip(metrics, bad, strict=True) if row[where])
        )
        raise NonFiniteError(
            f"not finite at update {first_update + where + 1}: {names}; training stopped, and any "
            "checkpoint is from an earlier update"
        )
