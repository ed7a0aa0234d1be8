"""The checkpoint of a training run, by Orbax: complete or absent."""

import logging
import math
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.mlp import Params
from quadjax.learners.loop import ChunkResult
from quadjax.learners.state import TrainState

# Orbax logs a traceback in every thread for an error that it also raises.
logging.getLogger("absl").setLevel(logging.CRITICAL)


class RunState(struct.PyTreeNode):
    """The progress of a run: what a checkpoint holds."""

    state: TrainState
    best: Params  # the parameters of the best score so far; the latest before the first
    best_score: float = math.inf
    best_steps: int = 0
    steps: int = 0  # environment steps of the run that are done
    seconds: float = 0.0  # of training, summed over all times that the run was resumed

    def after(self, result: ChunkResult, score: float, seconds: float) -> "RunState":
        """The state one chunk later, with the best parameters in the host's memory.

        Of equal scores the later one counts as better.

        Args:
            result: the run after the chunk.
            score: of its parameters; lower is better, infinite where no flight finishes.
            seconds: of training.
        """
        best, best_score, best_steps = self.best, self.best_score, self.best_steps
        if score <= best_score or math.isinf(best_score):
            best, best_score, best_steps = result.state.evaluated, score, result.steps
        return RunState(
            result.state, jax.device_get(best), best_score, best_steps, result.steps, seconds
        )


class Checkpoints:
    """The latest checkpoint of a run: its ``RunState``, in ``folder/latest``."""

    def __init__(self, folder: Path | str) -> None:
        """Open the folder, which is created if needed."""
        path = Path(folder).resolve() / "latest"
        path.mkdir(parents=True, exist_ok=True)
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=False, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(path, options=options)

    @property
    def exists(self) -> bool:
        """Whether there is a checkpoint to resume from."""
        return self._manager.latest_step() is not None

    def save(self, run_state: RunState) -> None:
        """Save the state of a run.

        Raises:
            InputError: it cannot be written; the last checkpoint stays.
        """
        manager = self._manager
        if manager.latest_step() == run_state.steps:
            return
        try:
            manager.save(run_state.steps, args=ocp.args.StandardSave(run_state))
            manager.wait_until_finished()
        except Exception as error:  # Orbax and TensorStore raise many kinds
            raise InputError(
                f"{manager.directory}: the checkpoint cannot be written ({_reason(error)}); the "
                "last one stays"
            ) from error

    def restore(self, shapes: TrainState) -> RunState:
        """The state in the checkpoint.

        Args:
            shapes: shapes and shardings of the state of a run of the same config; see
                ``quadjax.learners.parallel.placed_shapes``.

        Raises:
            InputError: the checkpoint is damaged.
        """
        manager, step = self._manager, self._manager.latest_step()
        best = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes.evaluated)
        like = RunState(state=shapes, best=best)
        try:
            restored: RunState = manager.restore(step, args=ocp.args.StandardRestore(like))
        except Exception as error:  # Orbax raises many kinds
            raise InputError(
                f"{manager.directory}: checkpoint {step} cannot be read ({_reason(error)}): "
                "replace the run (--overwrite)"
            ) from error
        return restored

    def close(self) -> None:
        """Release Orbax's resources."""
        self._manager.close()


def _reason(error: Exception) -> str:
    """The start of an error's message, as one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
