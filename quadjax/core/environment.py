"""The interface between tasks and learners: an environment is three pure functions of one agent.

``reset(params, key) -> state``
``observe(params, state) -> observation``
``step(params, state, action) -> (state, reward, terminated, truncated)``

Everything numeric is in the traced ``params``; a learner batches the functions with one ``vmap``.
The return of a *terminated* episode ends with the step. For a *truncated* episode learners
bootstrap from the observation after the step, before any reset. ``step`` does not reset.
"""

import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp

from quadjax.core.shapes import check_traced

Params = TypeVar("Params")
State = TypeVar("State")


@dataclasses.dataclass(frozen=True)
class Environment(Generic[Params, State]):
    """Three pure functions of one agent, and the sizes that a network needs.

    ``State`` is a pytree of arrays. Actions are unbounded; policies output about [-1, 1], and
    ``step`` clips them to its range. Rewards, flags and observations are single-precision, bool
    and single-precision. For SHAC, ``step`` must be differentiable.
    """

    reset: Callable[[Params, jax.Array], State]
    observe: Callable[[Params, State], jax.Array]  # -> (observation_size,)
    # -> next state, reward (), terminated () bool, truncated () bool
    step: Callable[[Params, State, jax.Array], tuple[State, jax.Array, jax.Array, jax.Array]]
    observation_size: int
    action_size: int
    # (before, after) -> () float, parts of the task that a step completed: gates passed. None: not
    # reported.
    completed: Callable[[State, State], jax.Array] | None = None


def vectorize(environment: Environment[Params, State]) -> Environment[Params, State]:
    """The environment of many agents: states batched along the last axis, all else along the first.

    With the agents on the last axis, each number of a state is contiguous over them, so
    that the compiler's loops use the vector instructions of a CPU.

    ``reset`` takes an array of keys, ``step`` an array of actions; ``params`` are shared.

    Raises:
        InputError: when traced, a result with a shape or type that ``Environment`` does not allow.
    """
    environment, completed = _checked(environment), environment.completed
    return dataclasses.replace(
        environment,
        reset=jax.vmap(environment.reset, in_axes=(None, 0), out_axes=-1),
        observe=jax.vmap(environment.observe, in_axes=(None, -1)),
        step=jax.vmap(environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0)),
        completed=None if completed is None else jax.vmap(completed, in_axes=-1),
    )


def _checked(environment: Environment[Params, State]) -> Environment[Params, State]:
    """The environment, whose observation and step are checked while they are traced."""

    def observe(params: Params, state: State) -> jax.Array:
        seen = environment.observe(params, state)
        check_traced("the environment's observation", seen, (environment.observation_size,))
        return seen

    def step(
        params: Params, state: State, action: jax.Array
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        following, reward, terminated, truncated = environment.step(params, state, action)
        check_traced("the environment's reward", reward, ())
        check_traced("terminated of the environment's step", terminated, (), bool)
        check_traced("truncated of the environment's step", truncated, (), bool)
        return following, reward, terminated, truncated

    return dataclasses.replace(environment, observe=observe, step=step)


def where_done(done: jax.Array, fresh: State, state: State) -> State:
    """``fresh`` where an episode is done, else ``state``; both batched along the last axis."""
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, state)
