"""Checkpoints by Orbax: the latest and the best, each complete or absent."""

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from quadjax.core.errors import InputError
from quadjax.learners import hosts
from quadjax.learners.loop import Position
from quadjax.learners.networks import ActorCritic
from quadjax.learners.state import TrainState

logging.getLogger("absl").setLevel(logging.ERROR)


def _is_key(leaf: object) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


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
        self._latest = self._best = None
        if hosts.is_first():
            self._latest = _manager(directory / "latest")
            self._best = _manager(directory / "best")

    def save(self, position: Position) -> None:
        """Save the position, and the best parameters if they are new.

        All processes of a run gather the state; the first one writes.
        """
        plain = hosts.gather(position.state)
        if self._latest is None:
            return
        meta = {
            "best_score": position.best_score if math.isfinite(position.best_score) else None,
            "best_steps": position.best_steps,
            "chunks": position.chunks,
            "seconds": position.seconds,
        }
        try:
            self._write(position, plain, meta)
        except Exception as error:  # Orbax and TensorStore raise many kinds
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise InputError(
                f"{self._latest.directory}: the checkpoint cannot be written ({reason[:200]}); "
                "the last one stays"
            ) from error

    def _write(self, position: Position, plain: TrainState, meta: dict[str, Any]) -> None:
        """Write the latest checkpoint, and the best if it is new."""
        if self._latest.latest_step() != position.chunks:
            tree = {"state": plain, "best": jax.device_get(position.best)}
            self._latest.save(position.chunks, args=_both(tree, meta))
        if self._best.latest_step() != position.best_steps and position.best_steps:
            self._best.save(position.best_steps, args=_both({"best": position.best}, meta))
        self._latest.wait_until_finished()
        self._best.wait_until_finished()

    @property
    def any(self) -> bool:
        """Whether there is a checkpoint to resume from."""
        there = self._latest is not None and self._latest.latest_step() is not None
        return hosts.agree(there)

    def restore(self, like: Position) -> Position:
        """The latest position.

        Args:
            like: a fresh position of the same run: the shapes to expect.

        Raises:
            InputError: the checkpoint is of a run of another shape, or damaged.
        """
        tree = {"state": hosts.gather(like.state), "best": jax.device_get(like.best)}
        restored, meta = tree, {}
        if self._latest is not None:
            restored, meta = self._read(tree)
        restored = hosts.share(restored)
        score = meta.get("best_score")
        numbers = [meta.get(name, 0) for name in ("best_steps", "chunks", "seconds")]
        best_steps, chunks, seconds = hosts.share(np.asarray(numbers, np.float64)).tolist()
        return dataclasses.replace(
            like,
            state=_as_before(restored["state"], like.state),
            best=ActorCritic(**vars(restored["best"])),
            best_score=math.inf if score is None else score,
            best_steps=int(best_steps),
            chunks=int(chunks),
            seconds=seconds,
        )

    def _read(self, tree: dict) -> tuple[dict, dict]:
        """The latest checkpoint's tree, of the shapes of ``tree``, and its meta data."""
        step = self._latest.latest_step()
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
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise InputError(
                f"{self._latest.directory}: checkpoint {step} cannot be read ({reason})"
            ) from error
        return found["tree"], found["meta"]

    def close(self) -> None:
        """Release Orbax's resources."""
        for manager in (self._latest, self._best):
            if manager is not None:
                manager.close()


def _manager(directory: Path) -> ocp.CheckpointManager:
    """A manager of one checkpoint, in this process alone."""
    directory.mkdir(parents=True, exist_ok=True)
    processes = ocp.options.MultiprocessingOptions(
        primary_host=0, active_processes={0}, barrier_sync_key_prefix=directory.name
    )
    together = {} if hosts.alone() else {"multiprocessing_options": processes}
    options = ocp.CheckpointManagerOptions(
        max_to_keep=1, create=False, enable_async_checkpointing=False, **together
    )
    return ocp.CheckpointManager(directory, options=options)


def _both(tree: dict, meta: dict) -> ocp.args.Composite:
    return ocp.args.Composite(tree=ocp.args.StandardSave(tree), meta=ocp.args.JsonSave(meta))
