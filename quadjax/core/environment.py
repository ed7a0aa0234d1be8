"""The interface between tasks and learners: an environment is three pure functions of one agent.

``reset(params, key) -> state``
``observe(params, state) -> observation``
``step(params, state, action) -> (state, reward, terminated, truncated)``

Everything numeric is in the traced ``params``; a learner batches the functions with one ``vmap``.
The return of a *terminated* episode ends with the step. For a *truncated* episode learners
bootstrap from the observation after the step, before any reset. ``step`` does not reset.
"""

import dataclasses
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp

from quadjax.core.shapes import check_traced

Params = TypeVar("Params")
State = TypeVar("State")


class Environment(Generic[Params, State]):
    """The base class of environments: pure functions of one agent, and sizes for a network.

    An environment is static: programs are compiled for it, and those of equal environments are
    shared. One with fields is a frozen dataclass, whose fields choose code; every number is in
    ``params``. ``State`` is a pytree of arrays. Actions are unbounded; policies output about
    [-1, 1], and ``step`` clips them to its range. Rewards, flags and observations are
    single-precision, bool and single-precision. For SHAC, ``step`` must be differentiable.
    """

    observation_size: int
    action_size: int

    def reset(self, params: Params, key: jax.Array) -> State:
        """A state at the start of an episode."""
        raise NotImplementedError

    def observe(self, params: Params, state: State) -> jax.Array:
        """The observation (observation_size,) of a state."""
        raise NotImplementedError

    def step(
        self, params: Params, state: State, action: jax.Array
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        """The next state, the reward (), and whether the episode is terminated () or truncated ().

        ``action`` is (action_size,); both flags are bool.
        """
        raise NotImplementedError

    def completed(self, before: State, after: State) -> jax.Array | None:
        """Parts () of the task that a step completed, such as gates passed; None: not reported."""
        return None

    def describe_dependents(self, params: Params, key: str) -> str:
        """What was computed from a number of ``params``, with its verb; "": nothing.

        It would not follow a schedule of the number, which is refused.
        """
        return ""


@dataclasses.dataclass(frozen=True)
class Vectorized(Environment[Params, State]):
    """An environment of many agents: states batched along the last axis, all else along the first.

    With the agents on the last axis, each number of a state is contiguous over them, so
    that the compiler's loops use the vector instructions of a CPU. ``reset`` takes an array of
    keys, ``step`` an array of actions; ``params`` are shared.

    Raises:
        InputError: when traced, a result with a shape or type that ``Environment`` does not allow.
    """

    one: Environment[Params, State]

    @property
    def observation_size(self) -> int:  # type: ignore[override]
        """Size of the observation of one agent."""
        return self.one.observation_size

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Size of the action of one agent."""
        return self.one.action_size

    def reset(self, params: Params, key: jax.Array) -> State:
        """Starts of episodes, of keys (n,)."""
        return jax.vmap(self.one.reset, in_axes=(None, 0), out_axes=-1)(params, key)

    def observe(self, params: Params, state: State) -> jax.Array:
        """Observations (n, observation_size)."""

        def checked(params: Params, state: State) -> jax.Array:
            seen = self.one.observe(params, state)
            check_traced("the environment's observation", seen, (self.observation_size,))
            return seen

        return jax.vmap(checked, in_axes=(None, -1))(params, state)

    def step(
        self, params: Params, state: State, action: jax.Array
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        """The next states, rewards (n,) and flags (n,), of actions (n, action_size)."""

        def checked(params: Params, state: State, action: jax.Array) -> tuple:
            next_state, reward, terminated, truncated = self.one.step(params, state, action)
            check_traced("the environment's reward", reward, ())
            check_traced("terminated of the environment's step", terminated, (), bool)
            check_traced("truncated of the environment's step", truncated, (), bool)
            return next_state, reward, terminated, truncated

        batched = jax.vmap(checked, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0))
        return batched(params, state, action)

    def completed(self, before: State, after: State) -> jax.Array | None:
        """Parts (n,) of the task that a step completed."""
        return jax.vmap(self.one.completed, in_axes=-1)(before, after)

    def describe_dependents(self, params: Params, key: str) -> str:
        """What was computed from a number of ``params``, which are those of one agent."""
        return self.one.describe_dependents(params, key)


def where_done(done: jax.Array, reset_states: State, states: State) -> State:
    """``reset_states`` where an episode is done, else ``states``; batched along the last axis."""
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), reset_states, states)
