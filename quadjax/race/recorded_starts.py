"""States of recorded flights in which episodes of training start."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.vectors import Vec3
from quadjax.vehicle.protocol import Motion


class RecordedStarts(struct.PyTreeNode):
    """States of flights, n of each."""

    motion: Motion  # components (n,)
    actuators: jax.Array  # (n, k) in [-1, 1] over the range of the start
    target: jax.Array  # (n,) int32, index of the gate to pass next
    fraction: jax.Array  # () of the episodes that start in one of them


def recorded_starts(
    motion: Sequence[np.ndarray], actuators: np.ndarray, target: np.ndarray, fraction: float
) -> RecordedStarts:
    """States as starts of a race.

    Args:
        motion: position, m, velocity, m/s, Euler angles, rad, and body rates, rad/s, (n, 3) each.
        actuators: (n, k), -1 and 1 at the ends of what a start draws; clipped to it.
        target: (n,) index of the gate to pass next.
        fraction: of the episodes that start in them.
    """
    vectors = (Vec3(*(jnp.asarray(x, jnp.float32) for x in values.T)) for values in motion)
    return RecordedStarts(
        Motion(*vectors),
        jnp.asarray(np.clip(actuators, -1.0, 1.0), jnp.float32),
        jnp.asarray(target, jnp.int32),
        jnp.float32(fraction),
    )


def draw_recorded(starts: RecordedStarts, key: jax.Array) -> tuple[jax.Array, RecordedStarts]:
    """Draw whether an episode starts in a recorded state, () bool, and one of the states.

    All states are equally likely.
    """
    which, whether = jax.random.uniform(key, (2,))
    count = starts.target.shape[0]
    index = jnp.minimum((which * count).astype(jnp.int32), count - 1)
    one = jax.tree.map(lambda values: values[index], starts.replace(fraction=None))
    return whether < starts.fraction, one
