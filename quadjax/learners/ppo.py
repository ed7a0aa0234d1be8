"""Proximal policy optimization (Schulman et al., 2017): its hyperparameters and its update.

1. ``collect`` simulates all environments with sampled actions.
2. ``td_lambda`` computes the targets of the value; the advantage is target minus value.
3. ``run_epochs`` iterates over shuffled minibatches. ``gradient_step`` takes one gradient step on
   ``loss`` for each. It skips the step if the policy has moved too far.

A subclass can override ``collect``, ``gradient_step``, ``loss`` and ``make_optimizer``. The floats
of ``self`` are arrays in them; ints, flags and None are static (``quadjax.core.traced``).
"""

import dataclasses
import functools
from typing import Annotated, Any, Self

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core.mlp import Params
from quadjax.core.sections import Code, Field, Fraction, Positive, Unit, model_validator
from quadjax.learners.learner import (
    Count,
    Discount,
    Learner,
    NumEnvs,
    RewardScale,
    check_divisor,
)
from quadjax.learners.networks import ActorCritic, mean_action, predict_value
from quadjax.learners.rollout import (
    Trajectory,
    clip,
    descend,
    draw,
    first_state,
    rollout,
    run_epochs,
    step_metrics,
    td_lambda,
)
from quadjax.learners.state import Metrics, Task, TrainState

MAX_RESET_INTERVAL = 64  # steps between two draws of the states that episodes restart from
EPSILON = 1e-5  # of Adam, as in Stable-Baselines3
Carry = tuple[Params, optax.OptState]


class Batch(struct.PyTreeNode):
    """Steps to learn from; the leading axes are all batch."""

    observation: jax.Array  # (..., observation_size)
    action: jax.Array  # (..., actions), sampled, not clipped
    log_prob: jax.Array  # (...) of the action under the policy that sampled it
    advantage: jax.Array  # (...) over the value before the update
    target: jax.Array  # (...) value target


class PPO(Learner):
    """Proximal policy optimization (Schulman et al., 2017)."""

    algorithm: Annotated[str, Code()] = Field("ppo", description="proximal policy optimization")
    num_envs: NumEnvs = 1024
    rollout_length: Annotated[Count, Unit("steps")] = Field(
        64, description="steps of each environment per update"
    )
    num_minibatches: Count = Field(8, description="minibatches per epoch")
    num_epochs: int = Field(5, ge=1, le=1000, description="passes over the data of an update")
    shuffle_block: Count | None = Field(
        None,
        description="consecutive steps of an environment that stay together when minibatches are "
        "drawn; null: all steps of an update",
    )
    learning_rate: Fraction = Field(7e-4, description="step size of Adam")
    discount: Discount = 0.99
    gae_lambda: Fraction = Field(0.95, description="lambda of generalized advantage estimation")
    clip_range: float = Field(
        0.2, gt=0, le=100, description="the probability ratio is clipped to 1 +- clip_range"
    )
    value_coefficient: float = Field(0.5, ge=0, le=1e6, description="weight of the value loss")
    entropy_coefficient: float = Field(0.0, ge=0, le=1e6, description="weight of the entropy bonus")
    max_grad_norm: Positive = Field(
        0.5, description="gradients are scaled to at most this global norm"
    )
    separate_grad_clip: bool = Field(
        True,
        description="clip the gradients of policy and value each by its own norm; false: by their "
        "common norm",
    )
    max_kl: Positive | None = Field(
        0.03,
        description="a minibatch whose estimated KL divergence from the policy before the update "
        "is larger is skipped; null: none is",
    )
    reward_scale: RewardScale = 1.0
    initial_log_std: float = Field(
        0.0,
        ge=-20,
        le=5,
        description="initial logarithm of the standard deviation of the action noise",
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        block = self.shuffle_block or self.rollout_length
        blocks = self.num_envs * (self.rollout_length // block)
        check_divisor("shuffle_block", block, self.rollout_length, "rollout_length")
        check_divisor("num_minibatches", self.num_minibatches, blocks, "blocks of an update")
        return self

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.num_envs * self.rollout_length

    def init(self, task: Task, key: jax.Array) -> TrainState:
        """The first state of a run."""
        state = first_state(task, key, self.num_envs, self.initial_log_std)
        return dataclasses.replace(state, optimizer=self.make_optimizer().init(state.params))

    def update(self, task: Task, state: TrainState) -> tuple[TrainState, Metrics]:
        """Simulate, and learn from the steps in several epochs of minibatches."""
        key, rollout_key, shuffle_key = jax.random.split(state.key, 3)
        env_states, (trajectory, log_prob) = self.collect(task, state, rollout_key)
        # One time step after another: hidden layers of all steps at once would need much memory.
        values = jax.lax.map(
            lambda x: predict_value(task.network, state.params, x), trajectory.observation
        )
        target = td_lambda(trajectory, self.discount, self.gae_lambda, self.reward_scale)
        batch = Batch(trajectory.observation, trajectory.action, log_prob, target - values, target)
        step = functools.partial(self.gradient_step, task.network)
        sizes = (self.num_epochs, self.num_minibatches, self.shuffle_block or self.rollout_length)
        start = (state.params, state.optimizer)
        (params, optimizer), metrics = run_epochs(step, start, batch, shuffle_key, *sizes)
        next_state = state.next_state(env_states, key, params=params, optimizer=optimizer)
        return next_state, {
            **jax.tree.map(jnp.mean, metrics),
            **step_metrics(trajectory, jnp.mean(batch.advantage**2), target),
            "kl_max": jnp.max(metrics["approx_kl"]),
            "learning_rate": jnp.asarray(self.learning_rate),
            "std": jnp.mean(jnp.exp(state.params["log_std"])),
        }

    def collect(
        self, task: Task, state: TrainState, key: jax.Array
    ) -> tuple[Any, tuple[Trajectory, jax.Array]]:
        """Simulate ``rollout_length`` steps of every environment with sampled actions.

        The state that an environment restarts from is drawn once for at most
        ``MAX_RESET_INTERVAL`` steps, because drawing it at every step takes longer than the
        simulation. An environment whose episode ends twice within an interval restarts from the
        same state.

        Returns:
            The environment states after the last step, reset where an episode ended; the
            trajectory, and the log densities (time, n) of its actions.
        """
        total, params = self.rollout_length, state.params
        length = max(d for d in range(1, min(total, MAX_RESET_INTERVAL) + 1) if total % d == 0)
        shape = (length, self.num_envs, task.network.action_size)

        def interval(states: Any, key: jax.Array) -> tuple[Any, tuple[Trajectory, jax.Array]]:
            reset_states, noise = draw(task, key, shape)
            deviation = jnp.broadcast_to(jnp.exp(params["log_std"]), shape) * noise
            states, trajectory = rollout(task, params, params, states, reset_states, deviation)
            # The density of an action about its mean is that of its noise about zero.
            return states, (
                trajectory,
                log_probability(deviation, jnp.zeros(shape), params["log_std"]),
            )

        keys = jax.random.split(key, total // length)
        env_states, intervals = jax.lax.scan(interval, state.env_states, keys)
        return env_states, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), intervals)

    def gradient_step(
        self, network: ActorCritic, carry: Carry, batch: Batch
    ) -> tuple[Carry, Metrics]:
        """One step of Adam.

        A minibatch whose KL divergence is above the limit or whose gradient is not finite changes
        neither the policy nor the value.
        """
        gradient, metrics = jax.grad(self.loss, has_aux=True)(carry[0], network, batch)
        critic = {"critic": gradient["critic"]}
        policy = {name: x for name, x in gradient.items() if name not in critic}
        norm = optax.tree.norm(policy if self.separate_grad_clip else gradient)
        if self.separate_grad_clip:
            gradient = clip(policy, self.max_grad_norm) | clip(critic, self.max_grad_norm)
        else:
            gradient = clip(gradient, self.max_grad_norm)
        accepted = True if self.max_kl is None else metrics["approx_kl"] <= self.max_kl
        carry, skipped = descend(self.make_optimizer(), gradient, carry, accepted)
        return carry, metrics | {"gradient_norm": norm, "skipped": skipped}

    def make_optimizer(self) -> optax.GradientTransformation:
        """Adam, for policy and value."""
        rate = jnp.asarray(self.learning_rate)
        return optax.chain(optax.scale_by_adam(eps=EPSILON), optax.scale(-rate))

    def loss(self, params: Params, network: ActorCritic, batch: Batch) -> tuple[jax.Array, Metrics]:
        """PPO's loss () of one minibatch, and its parts (Schulman et al., 2017, eq. 7 and 9).

        ``-mean(min(r A, clip(r, 1 - c, 1 + c) A)) + c_v mean((V - G)^2) - c_e H``, with ``r`` the
        ratio of the new to the old probability density, ``A`` the advantage, normalized over the
        minibatch (by its own standard deviation, without Bessel's correction), and ``G`` the value
        target. ``approx_kl`` is the estimator ``mean((r - 1) - log r)`` of KL(old, new) (Schulman,
        "Approximating KL divergence", 2020).
        """
        mean, log_std = mean_action(network, params, batch.observation), params["log_std"]
        log_ratio = log_probability(batch.action, mean, log_std) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = batch.advantage - jnp.mean(batch.advantage)
        advantage = advantage / (jnp.std(batch.advantage) + 1e-8)
        clipped = jnp.clip(ratio, 1.0 - self.clip_range, 1.0 + self.clip_range)
        policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
        value = predict_value(network, params, batch.observation)
        chex.assert_equal_shape([ratio, batch.advantage, value, batch.target])
        value_loss = jnp.mean((value - batch.target) ** 2)
        entropy = jnp.sum(log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))
        total = (
            policy_loss + self.value_coefficient * value_loss - self.entropy_coefficient * entropy
        )
        return total, {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "approx_kl": jnp.mean((ratio - 1.0) - log_ratio),
            "clip_fraction": jnp.mean((jnp.abs(ratio - 1.0) > self.clip_range).astype(ratio.dtype)),
        }


def log_probability(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log density (...) of an action (..., k) under independent normal distributions."""
    log_std = jnp.broadcast_to(log_std, action.shape)
    deviation = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(deviation**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)
