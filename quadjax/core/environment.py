"""The seam between tasks and learners: an environment is three pure functions of one agent.

``reset(params, key) -> state``, ``observe(params, state) -> observation`` and
``step(params, state, action) -> (state, reward, terminated, truncated)``. Everything numeric is in
the traced ``params``; a learner batches the functions with one ``vmap``.
"""

import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

import jax

Params = TypeVar("Params")
State = TypeVar("State")


@dataclasses.dataclass(frozen=True)
class Environment(Generic[Params, State]):
    """Three pure functions of one agent, and the sizes that a network needs."""

    reset: Callable[[Params, jax.Array], State]
    observe: Callable[[Params, State], jax.Array]  # -> (observation_size,)
    step: Callable[[Params, State, jax.Array], tuple[State, jax.Array, jax.Array, jax.Array]]
    observation_size: int
    action_size: int
