"""Tiny environments whose right values and actions are known, as one with traced weights.

Each is a choice of numbers, so that one compiled learner serves them all.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.networks import ActorCritic

SIZE = 3  # numbers of an observation


class Probe(struct.PyTreeNode):
    """Weights of the reward, the length of an episode and how it ends."""

    constant: jax.Array  # reward of every step
    shown: jax.Array  # reward of the observed sign
    last: jax.Array  # reward of an episode's last step
    best: jax.Array  # penalty on the squared distance of the action from one half
    follow: jax.Array  # penalty on that from one half of the sign
    place: jax.Array  # penalty on the squared position after a step
    move: jax.Array  # how far an action of one moves
    length: jax.Array  # steps of an episode
    truncates: jax.Array  # 1: episodes are truncated; 0: terminated


class State(struct.PyTreeNode):
    """A sign for the episode, a clock and a place."""

    sign: jax.Array
    clock: jax.Array
    place: jax.Array


def probe(**numbers: float) -> Probe:
    """A probe with all weights zero but those given; episodes of one step that terminate."""
    values = dict.fromkeys(Probe.__dataclass_fields__, 0.0) | {"length": 1.0} | numbers
    return Probe(**{name: np.float32(value) for name, value in values.items()})


class ProbeEnvironment(Environment[Probe, State]):
    """The environment of all probes."""

    observation_size, action_size = SIZE, 1

    def reset(self, params: Probe, key: jax.Array) -> State:
        drawn = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        sign = jnp.where(drawn[0] > 0, 1.0, -1.0).astype(params.move.dtype)
        return State(sign, jnp.zeros_like(sign), jnp.where(params.move > 0, drawn[1], 0.0))

    def observe(self, params: Probe, state: State) -> jax.Array:
        clock = (1.0 - params.truncates) * state.clock  # the cause of truncation is not observed
        return jnp.stack([state.sign, clock, state.place])

    def step(self, params: Probe, state: State, action: jax.Array) -> tuple:
        a = action[0]
        place = state.place + params.move * a
        clock = state.clock + 1.0
        done = clock >= params.length
        reward = (
            params.constant
            + params.shown * state.sign
            + params.last * done.astype(a.dtype)
            - params.best * (a - 0.5) ** 2
            - params.follow * (a - 0.5 * state.sign) ** 2
            - params.place * place**2
        )
        cut = params.truncates > 0
        return State(state.sign, clock, place), reward, done & ~cut, done & cut


ENVIRONMENT = ProbeEnvironment()
NETWORK = ActorCritic(1, (16, 16), activation="tanh")


def observations(sign: float = 1.0, clock: float = 0.0, place: float = 0.0) -> np.ndarray:
    """One observation (3,)."""
    return np.array([sign, clock, place], np.float32)
