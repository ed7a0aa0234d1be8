"""States of recorded flights in which episodes of training start, and their file.

The file (``.npz``) has the arrays ``position`` (n, 3), m, and ``velocity`` (n, 3), m/s, in the
world, ``euler`` (n, 3), rad, ``rates`` (n, 3), rad/s, body, ``actuators`` (n, k), propeller speeds
in rpm or specific thrust in m/s^2, and ``target`` (n,), the index of the gate to pass next; its
``meta`` has ``format: "quadjax-starts/1"`` and the name of the ``track``. A flight of
``quadjax limit --npz`` is such a file, too: its states are the nodes of its mesh.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.files import check_finite, read_npz, write_npz
from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Motion

FORMAT = "quadjax-starts/1"
LIMIT = "quadjax-limit/1"  # of a flight of quadjax limit
MOTION = ("position", "velocity", "euler", "rates")
NAMES = (*MOTION, "actuators", "target")


class RecordedStarts(struct.PyTreeNode):
    """States of flights, n of each."""

    motion: Motion  # components (n,)
    actuators: jax.Array  # (n, k) in [-1, 1] over the range of the start
    target: jax.Array  # (n,) int32, index of the gate to pass next
    fraction: jax.Array  # () of the episodes that start in one of them


def draw_recorded(starts: RecordedStarts, key: jax.Array) -> tuple[jax.Array, RecordedStarts]:
    """Draw whether an episode starts in a recorded state, () bool, and one of the states.

    All states are equally likely.
    """
    which, whether = jax.random.uniform(key, (2,))
    count = starts.target.shape[0]
    index = jnp.minimum((which * count).astype(jnp.int32), count - 1)
    one = jax.tree.map(lambda values: values[index], starts.replace(fraction=None))
    return whether < starts.fraction, one


@dataclass(frozen=True)
class States:
    """The content of a file of states."""

    arrays: dict[str, np.ndarray]  # as ``NAMES``
    track: str

    def __len__(self) -> int:
        return len(self.arrays["target"])

    def starts(
        self, fraction: float, actuator_range: tuple[np.ndarray, np.ndarray], gates: int, name: str
    ) -> RecordedStarts:
        """The states as starts of a race.

        Args:
            fraction: of the episodes that start in them.
            actuator_range: states (k,) of the actuators that a start draws as -1 and 1.
            gates: of the track.
            name: of the file, for the message.

        Raises:
            InputError: the target of a state is no gate of the track.
        """
        target = self.arrays["target"]
        if target.min() < 0 or target.max() >= gates:
            raise InputError(
                f"{name}: target is {int(target.min())} to {int(target.max())}, allowed: the "
                f"track's gates, 0 to {gates - 1}"
            )
        low, high = actuator_range
        scaled = 2.0 * (self.arrays["actuators"] - low) / (high - low) - 1.0
        motion = Motion(
            *(
                Vec3(*(jnp.asarray(column, jnp.float32) for column in self.arrays[key].T))
                for key in MOTION
            )
        )
        return RecordedStarts(
            motion,
            jnp.asarray(np.clip(scaled, -1.0, 1.0), jnp.float32),
            jnp.asarray(target, jnp.int32),
            jnp.float32(fraction),
        )

    def save(self, path: Path | str) -> None:
        """Write the file atomically."""
        write_npz(path, self.arrays, {"format": FORMAT, "track": self.track})


def read_states(path: Path | str) -> States:
    """Read and check a file of states, or the states of a flight of ``quadjax limit --npz``.

    Of a flight: one state for each node of the mesh but the last, with the gate ahead as its
    target and angles within -pi and pi.

    Raises:
        InputError: a missing or damaged file, or arrays of other shapes.
    """
    arrays, meta = read_npz(path, (FORMAT, LIMIT), (*NAMES, "leg_times"))
    if meta["format"] == LIMIT:
        arrays, meta = _nodes(arrays, meta), {}
    for name in NAMES:
        if name not in arrays:
            raise InputError(f"{path}: {name} is missing; expected {', '.join(NAMES)}")
        if arrays[name].dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} holds no numbers")
        check_finite(path, name, arrays[name])
    count = len(np.atleast_1d(arrays["target"]))
    for name in NAMES:
        shape, dims = arrays[name].shape, 1 if name == "target" else 2
        is_wide = name not in MOTION or shape[-1:] == (3,)
        if len(shape) != dims or shape[0] != count or count == 0 or not is_wide:
            raise InputError(
                f"{path}: {name} has the shape {shape}, expected a row for each of {max(1, count)} "
                f"states{', three numbers each' * (name in MOTION)}"
            )
    return States({name: arrays[name] for name in NAMES}, str(meta.get("track", "")))


def _nodes(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, np.ndarray]:
    """The states at the nodes of a flight of ``quadjax limit``; arrays that it lacks stay out."""
    states = {name: arrays[name][:-1] for name in NAMES if name in arrays}
    if "euler" in states:
        states["euler"] = np.remainder(states["euler"] + np.pi, 2.0 * np.pi) - np.pi
    nodes, legs = len(states.get("position", ())), len(arrays.get("leg_times", ()))
    gates = len(meta.get("track", ())) or legs
    return states | {"target": np.arange(nodes) * legs // max(nodes, 1) % max(gates, 1)}
