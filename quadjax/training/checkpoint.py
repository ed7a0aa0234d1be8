"""The checkpoint of a training run, by Orbax: complete or absent."""

import dataclasses
import errno
import logging
import math
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from quadjax.core.errors import InputError
from quadjax.core.files import check_space
from quadjax.learners.loop import Progress
from quadjax.learners.networks import ActorCritic
from quadjax.learners.state import TrainState

# Orbax logs a traceback in every thread for an error that it also raises.
logging.getLogger("absl").setLevel(logging.CRITICAL)


@dataclasses.dataclass(frozen=True)
class Position:
    """The progress of a run: what a checkpoint holds."""

    state: TrainState
    best: ActorCritic  # the parameters of the best score so far; the latest before the first
    best_score: float = math.inf
    best_steps: int = 0
    chunks: int = 0
    seconds: float = 0.0  # of training, summed over all times that the run was resumed

    def after(self, progress: Progress, score: float, seconds: float) -> "Position":
        """The position one chunk later, with the best parameters in the host's memory.

        Of equal scores the later one counts as better.

        Args:
            progress: the run after the chunk.
            score: of its parameters; lower is better, infinite where a flight does not finish.
            seconds: of training.
        """
        following = dataclasses.replace(
            self, state=progress.state, chunks=progress.chunks, seconds=seconds
        )
        if score > self.best_score and math.isfinite(self.best_score):
            return following
        best = jax.device_get(progress.state.evaluated)
        return dataclasses.replace(
            following, best=best, best_score=score, best_steps=progress.steps
        )


class Checkpoints:
    """The latest checkpoint of a run: its position, in ``folder/latest``."""

    def __init__(self, folder: Path | str) -> None:
        """Open the folder, which is created if needed."""
        path = Path(folder).resolve() / "latest"
        path.mkdir(parents=True, exist_ok=True)
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=False, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(path, options=options)

    def save(self, position: Position) -> None:
        """Save the position: the state, and the best parameters so far.

        Raises:
            InputError: it cannot be written; the last checkpoint stays.
        """
        manager, tree = self._manager, _tree(position)
        if manager.latest_step() == position.chunks:
            return
        # Twice the arrays, and the files that describe them.
        size = 2 * sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(tree)) + 2**17
        try:
            check_space(manager.directory, size)
            manager.save(position.chunks, args=ocp.args.StandardSave(tree))
            manager.wait_until_finished()
        except Exception as error:  # Orbax and TensorStore raise many kinds
            raise InputError(
                f"{manager.directory}: the checkpoint cannot be written ({_reason(error)}); the "
                "last one stays"
            ) from error

    @property
    def any(self) -> bool:
        """Whether there is a checkpoint to resume from."""
        return self._manager.latest_step() is not None

    def restore(self, like: Position) -> Position:
        """The position of the checkpoint.

        Args:
            like: a fresh position of a run of the same config, for the shapes.

        Raises:
            InputError: the checkpoint is damaged.
        """
        manager = self._manager
        step = manager.latest_step()
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), _tree(like)
        )
        try:
            restored: Any = manager.restore(step, args=ocp.args.StandardRestore(shapes))
        except Exception as error:  # Orbax raises many kinds
            raise InputError(
                f"{manager.directory}: checkpoint {step} cannot be read ({_reason(error)}): "
                "replace the run (overwrite=True)"
            ) from error
        best_score, seconds, best_steps, chunks = restored["numbers"].tolist()
        state = jax.tree.map(_with_keys, restored["state"], like.state)
        best = ActorCritic(**vars(restored["best"]))
        return Position(state, best, best_score, int(best_steps), int(chunks), seconds)

    def close(self) -> None:
        """Release Orbax's resources."""
        self._manager.close()


def _tree(position: Position) -> dict[str, Any]:
    """What a checkpoint holds, as NumPy arrays; keys as their integers."""
    numbers = [position.best_score, position.seconds, position.best_steps, position.chunks]
    plain = jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, position.state)
    return {
        "state": jax.device_get(plain),
        "best": jax.device_get(position.best),
        "numbers": np.array(numbers, np.float64),
    }


def _is_key(leaf: object) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _with_keys(plain: np.ndarray, like: jax.Array) -> jax.Array:
    """A restored array, as PRNG keys where ``like`` has them."""
    restored = jnp.asarray(plain)
    return jax.random.wrap_key_data(restored) if _is_key(like) else restored


def _reason(error: Exception) -> str:
    """One line: the system's words for a full disk, or the start of the message."""
    text = str(getattr(error, "strerror", None) or error).strip() or type(error).__name__
    full = os.strerror(errno.ENOSPC)
    return full if full in text else text.splitlines()[0][:200]
