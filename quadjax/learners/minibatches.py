"""Gradient steps on shuffled minibatches."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax

from quadjax.core.gradients import Scalar
from quadjax.learners.parallel import AXIS, constrain
from quadjax.learners.state import Metrics

Carry = TypeVar("Carry")


def run_epochs(
    step: Callable[[Carry, Any], tuple[Carry, Metrics]],
    carry: Carry,
    data: Any,
    key: jax.Array,
    num_epochs: int,
    num_minibatches: int,
    block: int,
) -> tuple[Carry, Metrics]:
    """Several passes over the data of an update, each in minibatches of another order.

    On several devices every one holds all data, and takes its part of the rows of each minibatch.

    Args:
        step: of a minibatch of rows (rows, ...).
        carry: what the steps change: parameters and the state of their optimizer.
        data: arrays (time, n, ...).
        key: PRNG key of the order.
        num_epochs: passes.
        num_minibatches: of a pass; divides the number of blocks.
        block: consecutive steps of one environment that stay together; divides time.

    Returns:
        The carry, and the metrics of every step, each (num_epochs, num_minibatches).
    """
    blocks = constrain(jax.tree.map(lambda x: _to_blocks(x, block), data))
    count = jax.tree.leaves(blocks)[0].shape[0]

    def minibatch(carry: Carry, chosen: jax.Array) -> tuple[Carry, Metrics]:
        rows = jax.tree.map(lambda x: _take(x, chosen), blocks)
        return step(carry, constrain(rows, AXIS))

    def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Metrics]:
        order = jax.random.permutation(key, count).reshape(num_minibatches, -1)
        return jax.lax.scan(minibatch, carry, order)

    return jax.lax.scan(epoch, carry, jax.random.split(key, num_epochs))


def _to_blocks(x: jax.Array, length: int) -> jax.Array:
    """Arrays (time, n, ...) as blocks of steps of one environment, (blocks, length, ...)."""
    time, n = x.shape[:2]
    x = x.reshape(time // length, length, n, *x.shape[2:])
    return jnp.moveaxis(x, 2, 0).reshape(-1, length, *x.shape[3:])


def _take(blocks: jax.Array, chosen: jax.Array) -> jax.Array:
    """The chosen blocks as rows (rows, ...)."""
    return blocks.at[chosen].get(mode="promise_in_bounds").reshape(-1, *blocks.shape[2:])


def clip(gradient: Any, limit: Scalar) -> Any:
    """The gradient, scaled to a global norm of at most ``limit``."""
    return optax.clip_by_global_norm(limit).update(gradient, optax.EmptyState())[0]


def descend(
    optimizer: optax.GradientTransformation,
    gradient: Any,
    carry: tuple[Any, optax.OptState],
    accepted: jax.Array | bool = True,
) -> tuple[tuple[Any, optax.OptState], jax.Array]:
    """One step of an optimizer on (parameters, its state), if the gradient is finite.

    Args:
        optimizer: its updates are added to the parameters.
        gradient: of the parameters.
        carry: parameters and the optimizer's state.
        accepted: () where it is false, the step changes nothing either.

    Returns:
        Parameters and state, and whether (1 or 0) the step was skipped.
    """
    accepted = jnp.isfinite(optax.tree.norm(gradient)) & accepted
    change, state = optimizer.update(gradient, carry[1], carry[0])
    new = (optax.apply_updates(carry[0], change), state)
    chosen = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, carry)
    return chosen, 1.0 - accepted.astype(jnp.float32)
