"""Checkpoints by Orbax: whole or not there, the latest and the best."""

import dataclasses
import logging
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from quadjax.errors import InputError
from quadjax.learn.loop import Position
from quadjax.learn.networks import ActorCritic
from quadjax.learn.state import TrainState

logging.getLogger("absl").setLevel(logging.ERROR)


def _is_key(leaf: object) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(state: TrainState) -> TrainState:
    """PRNG keys as the integers that they are, everything on the host."""
    return jax.device_get(
        jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, state)
    )


def _as_before(plain: TrainState, like: TrainState) -> TrainState:
    return jax.tree.map(
        lambda x, y: jax.random.wrap_key_data(jnp.asarray(x)) if _is_key(y) else jnp.asarray(x),
        plain,
        like,
    )


class Checkpoints:
    """The checkpoints of one run, in ``directory/latest`` and ``directory/best``."""

    def __init__(self, directory: Path | str) -> None:
        """Open, and create where it is not there."""
        directory = Path(directory).resolve()
        keep = ocp.CheckpointManagerOptions(
            max_to_keep=1, create=True, enable_async_checkpointing=False
        )
        self._latest = ocp.CheckpointManager(directory / "latest", options=keep)
        self._best = ocp.CheckpointManager(directory / "best", options=keep)

    def save(self, position: Position) -> None:
        """Save the position, and the best parameters if they are new."""
        meta = {
            "best_score": position.best_score if math.isfinite(position.best_score) else None,
            "best_steps": position.best_steps,
            "chunks": position.chunks,
            "seconds": position.seconds,
        }
        if self._latest.latest_step() != position.chunks:
            tree = {"state": _plain(position.state), "best": jax.device_get(position.best)}
            self._latest.save(position.chunks, args=_both(tree, meta))
        if self._best.latest_step() != position.best_steps and position.best_steps:
            self._best.save(position.best_steps, args=_both({"best": position.best}, meta))
        self._latest.wait_until_finished()
        self._best.wait_until_finished()

    @property
    def any(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return self._latest.latest_step() is not None

    def restore(self, like: Position) -> Position:
        """The latest position.

        Args:
            like: a fresh position of the same run: the shapes to expect.

        Raises:
            InputError: the checkpoint is of a run of another shape, or damaged.
        """
        step = self._latest.latest_step()
        tree = {"state": _plain(like.state), "best": jax.device_get(like.best)}
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), tree
        )
        try:
            found = self._latest.restore(
                step,
                args=ocp.args.Composite(
                    tree=ocp.args.StandardRestore(shapes), meta=ocp.args.JsonRestore()
                ),
            )
        except Exception as error:  # Orbax raises many kinds
            reason = str(error).splitlines()[0]
            raise InputError(
                f"{self._latest.directory}: checkpoint {step} cannot be read ({reason})"
            ) from error
        meta, restored = found["meta"], found["tree"]
        score = meta["best_score"]
        return dataclasses.replace(
            like,
            state=_as_before(restored["state"], like.state),
            best=ActorCritic(**vars(restored["best"])),
            best_score=math.inf if score is None else score,
            best_steps=meta["best_steps"],
            chunks=meta["chunks"],
            seconds=meta["seconds"],
        )

    def close(self) -> None:
        """Release what Orbax holds."""
        self._latest.close()
        self._best.close()


def _both(tree: dict, meta: dict) -> ocp.args.Composite:
    return ocp.args.Composite(tree=ocp.args.StandardSave(tree), meta=ocp.args.JsonSave(meta))
