"""The race with the interface of gymnax 1.0, of which only the spaces need gymnax."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from quadjax.core.environment import Environment, where_done
from quadjax.race.types import RaceParams, RaceState


class GymnaxRace:
    """The race of one drone as ``gymnax.environments.environment.Environment``; batch it by vmap.

    Observations are (observation_size,), actions (action_size,) in [-1, 1] and clipped. Limits,
    gate inflation and rewards are those of training; schedules are not applied.
    """

    name = "quadjax/Race-v0"

    def __init__(self, environment: Environment, params: RaceParams) -> None:
        """Prepare the race, which ``quadjax.make_race`` returns; ``params`` are the default."""
        self._race, self.default_params = environment, params
        self.num_actions = environment.action_size

    @functools.partial(jax.jit, static_argnames="self")
    def reset(self, key: jax.Array, params: RaceParams | None = None) -> tuple[Any, ...]:
        """The first observation and state of an episode."""
        params = params or self.default_params
        state = self._race.reset(params, key)
        return self._race.observe(params, state), state

    @functools.partial(jax.jit, static_argnames="self")
    def step(
        self, key: jax.Array, state: RaceState, action: jax.Array, params: RaceParams | None = None
    ) -> tuple[Any, ...]:
        """Observation, state, reward, terminated, truncated, info; resets at an episode's end.

        Info has the ``final_observation``, before the reset.
        """
        params = params or self.default_params
        after, reward, *over = self._race.step(params, state, action)
        final, (first, fresh) = self._race.observe(params, after), self.reset(key, params)
        info = {"terminated": over[0], "truncated": over[1], "final_observation": final}
        done = over[0] | over[1]
        return jnp.where(done, first, final), where_done(done, fresh, after), reward, *over, info

    def action_space(self, params: RaceParams | None = None) -> Any:
        """``gymnax.environments.spaces.Box`` of the actions."""
        return _box(1.0, self.num_actions)

    def observation_space(self, params: RaceParams | None = None) -> Any:
        """``gymnax.environments.spaces.Box`` without bounds."""
        return _box(jnp.inf, self._race.observation_size)


def _box(bound: float, size: int) -> Any:
    from gymnax.environments.spaces import Box

    return Box(-bound, bound, (size,))
