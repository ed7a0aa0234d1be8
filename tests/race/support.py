"""A race made of defaults and overrides, and one compiled step of it for rows of drones."""

import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import build_params, choices_of
from quadjax.config.schema import Config
from quadjax.race import environment
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.track import make_track
from tests import reference as ref
from tests.convert import state_of

BLANK = Path(__file__).parent.parent / "blank.yaml"


def make_config(*overrides: str) -> Config:
    return load_config(BLANK, overrides)


def make_race(*overrides: str) -> tuple[Choices, RaceParams]:
    config = make_config(*overrides)
    return choices_of(config), build_params(config)


def track_of(gates: np.ndarray, yaw: np.ndarray, size: Sequence = (1.0, 1.0)):
    sizes = np.broadcast_to(np.asarray(size, np.float32), (len(gates), 2))
    columns = (jnp.asarray(x, jnp.float32) for x in (gates, yaw, sizes))
    return make_track(*columns)


def race_state(kind: str, rows: np.ndarray, target: object = 0, step: object = 0) -> RaceState:
    """States of rows of drones on their way to ``target``."""
    count = len(rows)
    return RaceState(
        drone=state_of(kind, np.asarray(rows, np.float32)),
        target=jnp.asarray(np.broadcast_to(target, count), jnp.int32),
        step=jnp.asarray(np.broadcast_to(step, count), jnp.int32),
        gates_passed=jnp.zeros(count, jnp.int32),
        constants=None,
    )


@functools.cache
def compiled_transition(choices: Choices):
    return jax.jit(
        jax.vmap(functools.partial(environment.transition, choices), in_axes=(None, 0, 0))
    )


@functools.cache
def compiled_observe(choices: Choices):
    return jax.jit(jax.vmap(functools.partial(environment.observe, choices), in_axes=(None, 0)))


@functools.cache
def compiled_reset(choices: Choices):
    return jax.jit(jax.vmap(functools.partial(environment.reset, choices), in_axes=(None, 0)))


def level(positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Rows of level motor-level drones with hovering propellers."""
    positions, velocities = np.broadcast_arrays(np.atleast_2d(positions), velocities)
    rows = np.zeros((len(positions), 22))
    rows[:, ref.P], rows[:, ref.V], rows[:, ref.RPM] = positions, velocities, 7497.0
    return rows


HOVER = (7497.0 - 7000.0) / 4000.0


def step(race, rows, target=0, clock=0, action=HOVER, kind="motor"):
    """One step of rows of drones; with Euler a position moves by exactly dt times velocity."""
    choices, params = race
    actions = np.broadcast_to(np.asarray(action, np.float32), (len(rows), 4))
    state = race_state(kind, rows, target, clock)
    return compiled_transition(choices)(params, state, jnp.asarray(actions))


def through(gate: int, forward: float, right: float = 0.0, down: float = 0.0) -> np.ndarray:
    """A world position in a gate's own frame of the square track."""
    yaw = ref.GATE_YAW[gate]
    ahead, side = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    return ref.GATES[gate] + forward * ahead + right * side + [0, 0, down]


def normal(gate: int) -> np.ndarray:
    """The unit vector of the way through a gate of the square track."""
    return np.array([np.cos(ref.GATE_YAW[gate]), np.sin(ref.GATE_YAW[gate]), 0])
