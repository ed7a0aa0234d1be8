"""The checkpoint of a training run, by Orbax: complete or absent."""

import dataclasses
import errno
import logging
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from quadjax.core.errors import InputError
from quadjax.core.files import check_space
from quadjax.learners.loop import Position
from quadjax.learners.networks import ActorCritic
from quadjax.learners.state import TrainState

# Orbax logs a traceback in every thread for an error that it also raises.
logging.getLogger("absl").setLevel(logging.CRITICAL)


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
        tree, manager = _tree(position), self._manager
        if manager.latest_step() == position.chunks:
            return
        try:
            check_space(manager.directory, _most_bytes(tree))
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
        restored: Any = _read(self._manager, _tree(like))
        best_score, seconds, best_steps, chunks = restored["numbers"].tolist()
        return dataclasses.replace(
            like,
            state=_with_keys(restored["state"], like.state),
            best=ActorCritic(**vars(restored["best"])),
            best_score=best_score,
            best_steps=int(best_steps),
            chunks=int(chunks),
            seconds=seconds,
        )

    def close(self) -> None:
        """Release Orbax's resources."""
        self._manager.close()


def _tree(position: Position) -> dict[str, Any]:
    """What a checkpoint holds, as NumPy arrays."""
    numbers = [position.best_score, position.seconds, position.best_steps, position.chunks]
    return {
        "state": jax.device_get(jax.tree.map(_numbers, position.state)),
        "best": jax.device_get(position.best),
        "numbers": np.array(numbers, np.float64),
    }


def _most_bytes(tree: dict[str, Any]) -> int:
    """More bytes than a checkpoint takes: twice its arrays, and the files that describe them."""
    return 2 * sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(tree)) + 2**17


def _read(manager: ocp.CheckpointManager, tree: dict[str, Any]) -> dict[str, Any]:
    """The checkpoint's tree, of the shapes of ``tree``."""
    step = manager.latest_step()
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), tree)
    try:
        return manager.restore(step, args=ocp.args.StandardRestore(shapes))
    except Exception as error:  # Orbax raises many kinds
        raise InputError(
            f"{manager.directory}: checkpoint {step} cannot be read ({_reason(error)}): replace "
            "the run (overwrite=True)"
        ) from error


def _reason(error: Exception) -> str:
    """One line: the system's own words for a full disk, or the start of the message."""
    text = str(getattr(error, "strerror", None) or error).strip() or type(error).__name__
    full = os.strerror(errno.ENOSPC)
    return full if full in text else text.splitlines()[0][:200]


def _numbers(leaf: jax.Array) -> jax.Array:
    """The integers of a PRNG key; any other array as it is."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: object) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _with_keys(plain: TrainState, like: TrainState) -> TrainState:
    """A restored state with PRNG keys where ``like`` has them."""
    return jax.tree.map(
        lambda x, y: jax.random.wrap_key_data(jnp.asarray(x)) if _is_key(y) else jnp.asarray(x),
        plain,
        like,
    )
