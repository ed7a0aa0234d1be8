"""What only the critic observes in training: the drawn constants of the drone.

An asymmetric actor-critic (Pinto et al., 2017, arXiv 1710.06542): the observation of training ends
with numbers that the policy's network does not take.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from quadjax.core.environment import Environment
from quadjax.race.environment import RaceParams, RaceState
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Constants

Spread = tuple[tuple[str, float], ...]  # names of constants, and the largest relative error of each


def with_constants(
    environment: Environment[RaceParams, RaceState], spread: Spread
) -> Environment[RaceParams, RaceState]:
    """The environment whose observation ends with the drawn constants.

    Each is its relative error, divided by the largest one that is drawn.

    Args:
        environment: of the race, which draws constants.
        spread: of the drawn constants; 1 where their population has no such number.
    """

    def observe(params: RaceParams, state: RaceState) -> jax.Array:
        constants = state.constants
        assert constants is not None
        seen = environment.observe(params, state)
        one = functools.partial(_relative, params.vehicle.constants, constants)
        return jnp.concatenate([seen, jnp.stack([one(*each) for each in spread])])

    size = environment.observation_size + len(spread)
    return dataclasses.replace(environment, observe=observe, observation_size=size)


def _relative(nominal: Constants, drawn: Constants, name: str, most: float) -> jax.Array:
    own = values_of(nominal)[name]
    size = jnp.where(own == 0.0, 1.0, jnp.abs(own))
    return (values_of(drawn)[name] - own) / (size * most)
