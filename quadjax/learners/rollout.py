"""What all learners share: rollouts, targets of the value, gradient steps on minibatches."""

from collections.abc import Callable
from typing import Any, TypeVar

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core.environment import where_done
from quadjax.core.gradients import Scalar
from quadjax.core.mlp import Params
from quadjax.learners.networks import initial_params, mean_action, predict_value
from quadjax.learners.parallel import AXIS, constrain
from quadjax.learners.state import Metrics, Task, TrainState

Carry = TypeVar("Carry")
Results = TypeVar("Results")


class Trajectory(struct.PyTreeNode):
    """A trajectory of each environment; axes are time, environment, then the quantity's own."""

    observation: jax.Array  # (time, n, observation_size)
    action: jax.Array  # (time, n, actions), sampled, not clipped
    reward: jax.Array  # (time, n)
    next_value: jax.Array  # (time, n) of the observation after the step, before any reset
    terminated: jax.Array  # (time, n) bool
    truncated: jax.Array  # (time, n) bool
    completed: jax.Array | None  # (time, n), where the environment reports it


def first_state(task: Task, key: jax.Array, num_envs: int, log_std: Scalar) -> TrainState:
    """A run's first state, without an optimizer, a target and a moving average."""
    network_key, reset_key, key = jax.random.split(key, 3)
    params = initial_params(task.network, network_key, task.environments.observation_size)
    keys = jax.random.split(reset_key, num_envs)
    return TrainState(
        params={**params, "log_std": jnp.full_like(params["log_std"], log_std)},
        optimizer=(),
        target=None,
        env_states=task.environments.reset(task.env_params, keys),
        key=key,
        update=jnp.zeros((), jnp.int32),
    )


def draw(task: Task, key: jax.Array, shape: tuple[int, int, int]) -> tuple[Any, jax.Array]:
    """Random states that episodes restart from, and standard normal noise (time, n, actions)."""
    reset_key, noise_key = jax.random.split(key)
    keys = constrain(jax.random.split(reset_key, shape[1]), AXIS)
    noise = constrain(jax.random.normal(noise_key, shape), None, AXIS)
    return task.environments.reset(task.env_params, keys), noise


def rollout(
    task: Task,
    actor: Params,
    critic: Params,
    states: Any,
    reset_states: Any,
    noise: jax.Array,
    before_step: Callable[[Any], Any] = lambda states: states,
) -> tuple[Any, Trajectory]:
    """Simulate every environment with noise on its actions; differentiable if they are.

    Args:
        task: the environment and the network.
        actor: parameters of the policy.
        critic: parameters whose value ``next_value`` is.
        states: environment states.
        reset_states: the states that an ended episode restarts from.
        noise: (time, n, actions) to add to the mean action.
        before_step: applied to the states before each step.

    Returns:
        The environment states after the last step, reset where an episode ended, and the
        trajectory, through whose observations and actions no gradient flows.
    """
    environments, network, params = task.environments, task.network, task.env_params

    def step(states: Any, noise: jax.Array) -> tuple[Any, Trajectory]:
        states = before_step(states)
        observation = environments.observe(params, states)
        action = mean_action(network, actor, observation) + noise
        next_states, reward, terminated, truncated = environments.step(params, states, action)
        trajectory = Trajectory(
            observation=jax.lax.stop_gradient(observation),
            action=jax.lax.stop_gradient(action),
            reward=reward,
            next_value=predict_value(network, critic, environments.observe(params, next_states)),
            terminated=terminated,
            truncated=truncated,
            completed=environments.completed(states, next_states),
        )
        return where_done(terminated | truncated, reset_states, next_states), trajectory

    return jax.lax.scan(step, states, noise)


def td_lambda(
    trajectory: Trajectory, discount: Scalar, trace_decay: Scalar, reward_scale: Scalar = 1.0
) -> jax.Array:
    """TD(lambda) target (time, n) of the value of the observation before each step.

    ``G_t = c r_t + discount ((1 - lambda) V(s'_t) + lambda G_{t+1})``, with lambda
    ``trace_decay`` and c ``reward_scale``.

    ``s'_t`` is the state after the step and before any reset. At the last step and where an episode
    is truncated, ``V(s'_t)`` alone takes the place of the mixture, so that a truncated episode
    bootstraps from its last observation; where it is terminated, zero does (Xu et al., 2022, eq.
    7). The advantage of generalized advantage estimation (Schulman et al., 2016) is
    ``G_t - V(s_t)``.
    """
    chex.assert_equal_shape(
        [trajectory.reward, trajectory.next_value, trajectory.terminated, trajectory.truncated]
    )

    def backward(next_target: jax.Array, step: Trajectory) -> tuple[jax.Array, jax.Array]:
        mixed = (1.0 - trace_decay) * step.next_value + trace_decay * next_target
        future = jnp.where(step.truncated, step.next_value, mixed)
        future = jnp.where(step.terminated, 0.0, future)
        target = reward_scale * step.reward + discount * future
        return target, target

    return jax.lax.scan(backward, trajectory.next_value[-1], trajectory, reverse=True)[1]


def step_metrics(trajectory: Trajectory, error: jax.Array, target: jax.Array) -> Metrics:
    """Metrics of all steps of an update, with the value's mean squared error () and its targets.

    Returns:
        ``reward``: mean per step; ``terminated``: fraction of steps that terminate an episode;
        ``crash_rate``: fraction of ended episodes that were terminated rather than truncated;
        ``explained_variance``: ``1 - error / Var(target)``, 1 for a perfect value and 0 for a
        constant; where the environment reports what was completed, ``pass_rate``: completed parts
        of the task, divided by the sum of these and terminated episodes. The end of a course counts
        as terminated here, and in ``crash_rate``.
    """
    terminated = jnp.mean(trajectory.terminated.astype(jnp.float32))
    truncated = jnp.mean(trajectory.truncated.astype(jnp.float32))
    metrics = {
        "reward": jnp.mean(trajectory.reward),
        "crash_rate": terminated / jnp.maximum(terminated + truncated, 1e-9),
        "terminated": terminated,
        "explained_variance": 1.0 - error / jnp.maximum(jnp.var(target), 1e-9),
    }
    if trajectory.completed is not None:
        passed = jnp.mean(trajectory.completed)
        metrics["pass_rate"] = passed / jnp.maximum(passed + terminated, 1e-9)
    return metrics


def run_epochs(
    step: Callable[[Carry, Any], tuple[Carry, Results]],
    carry: Carry,
    data: Any,
    key: jax.Array,
    num_epochs: int,
    num_minibatches: int,
    block: int,
) -> tuple[Carry, Results]:
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
        The carry, and the results of every step, each (num_epochs, num_minibatches).
    """

    def in_blocks(x: jax.Array) -> jax.Array:
        """Blocks of steps of one environment, (blocks, block, ...)."""
        time, n, *rest = x.shape
        x = x.reshape(time // block, block, n, *rest)
        return jnp.moveaxis(x, 2, 0).reshape(-1, block, *rest)

    blocks = constrain(jax.tree.map(in_blocks, data))
    count = jax.tree.leaves(blocks)[0].shape[0]

    def minibatch(carry: Carry, chosen: jax.Array) -> tuple[Carry, Results]:
        def rows_of(blocks: jax.Array) -> jax.Array:
            taken = blocks.at[chosen].get(mode="promise_in_bounds")
            return taken.reshape(-1, *blocks.shape[2:])

        return step(carry, constrain(jax.tree.map(rows_of, blocks), AXIS))

    def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Results]:
        order = jax.random.permutation(key, count).reshape(num_minibatches, -1)
        return jax.lax.scan(minibatch, carry, order)

    return jax.lax.scan(epoch, carry, jax.random.split(key, num_epochs))


def clip(gradient: Any, limit: Scalar) -> Any:
    """The gradient, scaled to a global norm of at most ``limit``."""
    return optax.clip_by_global_norm(limit).update(gradient, optax.EmptyState())[0]


def descend(
    optimizer: optax.GradientTransformation,
    gradient: Any,
    carry: tuple[Any, optax.OptState],
    accepted: jax.Array | bool = True,
) -> tuple[tuple[Any, optax.OptState], jax.Array]:
    """One step of an optimizer on a carry of parameters and its state, if the gradient is finite.

    Where ``accepted`` () is false, the step changes nothing either.

    Returns:
        Parameters and state, and whether (1 or 0) the step was skipped.
    """
    accepted = jnp.isfinite(optax.tree.norm(gradient)) & accepted
    change, state = optimizer.update(gradient, carry[1], carry[0])
    new = (optax.apply_updates(carry[0], change), state)
    chosen = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, carry)
    return chosen, 1.0 - accepted.astype(jnp.float32)
