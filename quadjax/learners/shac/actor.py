"""The policy's step: gradient ascent on the return of a short rollout."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from quadjax.core.environment import Environment
from quadjax.core.gradients import Scalar
from quadjax.learners.networks import Networks, Tree
from quadjax.learners.optimization import clip_by_norm, descend, select
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.shac.rollout import Trajectory, rollout_return
from quadjax.learners.state import AXIS, Metrics, TrainState


def collect_gradient(
    environment: Environment,
    networks: Networks,
    hyper: SHAC,
    environment_params: Any,
    state: TrainState,
    fresh: Any,
    noise: jax.Array,
) -> tuple[jax.Array, Tree, Any, Trajectory]:
    """A rollout, and the gradient of the policy's loss through it.

    The loss is the negative return, averaged over all steps of all devices.

    Returns:
        The loss (), its gradient, the environment states after the rollout, and the trajectory.
    """

    def loss(policy: Tree) -> tuple[jax.Array, tuple[Any, Trajectory]]:
        value, result = rollout_return(
            environment,
            networks,
            hyper,
            environment_params,
            dataclasses.replace(state.params, policy=policy),
            state.target,
            state.environment,
            fresh,
            noise,
        )
        return -value, result

    differentiate = jax.value_and_grad(loss, has_aux=True)
    (value, (environment_state, trajectory)), gradient = differentiate(state.params.policy)
    weight = 1.0 / (hyper.num_envs * hyper.horizon)
    value, gradient = jax.lax.psum(jax.tree.map(lambda x: x * weight, (value, gradient)), AXIS)
    return value, gradient, environment_state, trajectory


def policy_step(
    hyper: SHAC, state: TrainState, gradient: Tree
) -> tuple[Tree, optax.OptState, Metrics]:
    """One step of Adam on the policy.

    A gradient that is not finite changes nothing. While the critic warms up the policy stays as it
    is, and Adam's moments are updated.
    """
    gradient, norm = clip_by_norm(gradient, hyper.max_grad_norm)
    old = (state.params.policy, state.optimizer[0])
    new = adam_step(hyper, hyper.learning_rate, gradient, *old)
    finite = jnp.isfinite(norm)
    policy, optimizer = select(finite, new, old)
    policy = select(state.update >= hyper.critic_warmup, policy, old[0])
    metrics = {
        "gradient_norm": norm,
        "skipped": 1.0 - finite.astype(norm.dtype),
        "learning_rate": jnp.asarray(hyper.learning_rate),
    }
    return policy, optimizer, metrics


def adam_step(
    hyper: SHAC, rate: Scalar, gradient: Tree, params: Tree, optimizer: optax.OptState
) -> tuple[Tree, optax.OptState]:
    """One step of Adam against a gradient; the new parameters and Adam's state."""
    adam = optax.scale_by_adam(b1=hyper.adam_b1, b2=hyper.adam_b2)
    direction, optimizer = adam.update(gradient, optimizer)
    return descend(params, direction, rate), optimizer
