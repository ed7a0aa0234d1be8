"""What a simulated drone is that an autopilot can fly, and what it shows.

A world is two pure functions of a state: its start, and a control step under a command that is
held. Both also give what the autopilot observes, and the true motion for the record.
"""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.race.laps import Laps
from quadjax.race.track import Track
from quadjax.sil.message import CommandKind
from quadjax.vehicle.protocol import VehicleModel

KINDS = {  # of the vehicle models' commands
    "motor": CommandKind.ROTOR_SPEEDS_RAD_S,
    "rate": CommandKind.RATES_RAD_S_AND_THRUST_M_S2,
    "racing": CommandKind.MOTORS_0_TO_1,
    "a2rl": CommandKind.MOTORS_0_TO_1,
}


def command_kind(model: VehicleModel) -> CommandKind:
    """The kind of a vehicle model's commands.

    Raises:
        InputError: a model whose commands have no message.
    """
    if model.name not in KINDS:
        raise InputError(
            f"vehicle model {model.name!r} has no messages, allowed: {', '.join(KINDS)}"
        )
    return KINDS[model.name]


@struct.dataclass
class Seen:
    """What one control step shows."""

    numbers: jax.Array  # (n,) float32 of ``message.STATE_FIELDS``, without the target
    target: jax.Array  # () int32
    true: jax.Array  # (12 + actuators,): position, velocity, Euler angles, rates, actuators
    over: jax.Array  # () bool


@dataclasses.dataclass(frozen=True)
class Now:
    """A drone between two control steps."""

    state: Any  # pytree of the world
    numbers: np.ndarray
    target: int
    true: np.ndarray
    over: bool

    @classmethod
    def of(cls, state: Any, seen: Seen) -> "Now":
        """The arrays on the host."""
        shown = jax.device_get(seen)
        return cls(state, shown.numbers, int(shown.target), shown.true, bool(shown.over))


class World(Protocol):
    """A simulated drone in a race."""

    @property
    def name(self) -> str:
        """For the result."""

    @property
    def model(self) -> VehicleModel:
        """Of the commands."""

    @property
    def step(self) -> float:
        """Of the control loop, s."""

    @property
    def limit(self) -> int:
        """Control steps, after which a race is out of time."""

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command (4,), in the model's units."""

    def begin(self, seed: int) -> Now:
        """A race before its first step."""

    def advance(self, now: Now, command: np.ndarray) -> Now:
        """One control step later under a command (4,), in the model's units."""

    def result(self, now: Now) -> Laps:
        """The laps of the race so far."""


def scaled(rotors: Rotors, factor: float) -> Rotors:
    """Rotor speeds in another unit."""
    return jax.tree.map(lambda x: x * jnp.float32(factor), rotors)


def numbers(
    position: Vec3,
    velocity: Vec3,
    body_velocity: Vec3,
    euler: Vec3,
    rates: Vec3,
    rotors: Rotors,
    thrust: jax.Array,
    gyro: Vec3,
    specific_force: Vec3,
    moment: Vec3,
    force: Vec3,
    track: Track,
    target: jax.Array,
) -> jax.Array:
    """The floats of ``message.STATE_FIELDS``, in order."""
    center = jax.tree.map(lambda x: x[target], track.position)
    parts = (position, velocity, body_velocity, euler, quaternion.of_euler(euler), rates, rotors)
    more = (thrust, gyro, specific_force, moment, force, center, track.yaw[target])
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in jax.tree.leaves((parts, more))])
