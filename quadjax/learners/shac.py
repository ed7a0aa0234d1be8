"""Short-horizon actor-critic (Xu et al., 2022): its hyperparameters and its update.

1. ``collect_gradient`` simulates all environments over a short horizon, and differentiates their
   discounted return, ``total_return``, through the simulator.
2. A step of Adam or Muon moves the policy along this gradient, if it is finite.
3. ``fit_critic`` fits the value to TD(lambda) targets of the same steps.

A subclass can override each method. The floats of ``self`` are arrays in them
(``quadjax.core.traced``).

A target critic and the moving average that is evaluated follow the parameters. Muon (Jordan,
https://kellerjordan.github.io/posts/muon, 2024) brings the singular values of the momentum of a
weight matrix close to one.
"""

import dataclasses
from typing import Annotated, Any, ClassVar, Literal, Self

import chex
import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec

from quadjax.core.gradients import Scalar, scale_and_clip_cotangent
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
from quadjax.learners.networks import predict_value
from quadjax.learners.parallel import AXIS, SHARED, split_last, sum_over_devices
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

TARGET_RATE = 0.2  # part of the distance to the critic that its target moves in an update
MUON_BETA = 0.9  # decay of the momentum of Muon
MUON_RMS = 0.8  # root mean square of an orthogonal step of a matrix, in learning rates
EMA_FRACTION = 20.0  # the moving average covers about one part in 20 of the updates so far


class SHAC(Learner):
    """Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""

    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "clipped_mean"

    algorithm: Annotated[str, Code()] = Field("shac", description="short-horizon actor-critic")
    num_envs: NumEnvs = 256
    horizon: Annotated[int, Unit("steps")] = Field(
        48,
        ge=1,
        le=4096,
        description="steps of each environment per update, through which gradients flow",
    )
    optimizer: Literal["adam", "muon"] = Field(
        "adam",
        description="optimizer of the policy: adam, or muon for its matrices, with Adam (Nesterov "
        "momentum) for its other parameters; the critic has Adam",
    )
    learning_rate: Fraction = Field(3e-3, description="step size of the policy's optimizer")
    adam_b1: float = Field(0.7, ge=0, lt=1, description="decay of Adam's first moment")
    adam_b2: float = Field(0.95, ge=0, lt=1, description="decay of Adam's second moment")
    max_grad_norm: Positive = Field(
        1.0, description="the policy's gradient is scaled to at most this global norm"
    )
    critic_learning_rate: Fraction = Field(3e-3, description="step size of the critic's Adam")
    critic_max_grad_norm: Positive = Field(
        1.0, description="the critic's gradient is scaled to at most this global norm"
    )
    critic_epochs: int = Field(
        4, ge=1, le=1000, description="passes of the critic over the data of an update"
    )
    critic_minibatches: Count = Field(4, description="minibatches of the critic per epoch")
    td_lambda: Fraction = Field(0.95, description="lambda of the critic's TD targets")
    discount: Discount = 0.99
    cotangent_decay: Annotated[Fraction, Unit("decay")] = Field(
        0.95, description="factor per step on the gradient that flows back through the state"
    )
    cotangent_clip: Annotated[Positive, Unit("gradient")] = Field(
        0.02,
        description="largest entry of the gradient that flows back through the state, in units of "
        "the scaled return",
    )
    std: float = Field(
        0.3, gt=0, le=100, description="standard deviation of the action noise (actions: -1 to 1)"
    )
    reward_scale: RewardScale = 0.1
    ema_rate: float = Field(
        1.0,
        ge=1e-4,
        le=1,
        description="weight of the newest parameters in the exponential moving average that is "
        "evaluated and saved, per update; 1: no averaging",
    )

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        check_divisor("critic_minibatches", self.critic_minibatches, self.num_envs, "num_envs")
        return self

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.num_envs * self.horizon

    def init(self, task: Task, key: jax.Array) -> TrainState:
        """The first state of a run."""
        state = first_state(task, key, self.num_envs, jnp.log(self.std))
        params, adam, optimizer = state.params, self.make_adam(0.0), self.make_policy_optimizer(0.0)
        return dataclasses.replace(
            state,
            optimizer=(optimizer.init(params["actor"]), adam.init(params["critic"])),
            target=jax.tree.map(jnp.copy, params),
            ema=jax.tree.map(jnp.copy, params),
        )

    def update(self, task: Task, state: TrainState) -> tuple[TrainState, Metrics]:
        """Move the policy along the gradient of a rollout, and fit the critic to its steps."""
        key, rollout_key, shuffle_key = jax.random.split(state.key, 3)
        loss, gradient, env_states, trajectory = self.collect_gradient(task, state, rollout_key)
        optimizer = self.make_policy_optimizer(self.learning_rate)
        carry = (state.params["actor"], state.optimizer[0])
        (actor, actor_optimizer), skipped = descend(
            optimizer, clip(gradient, self.max_grad_norm), carry
        )
        fitted = self.fit_critic(task, state, trajectory, shuffle_key)
        critic, critic_optimizer, critic_metrics = fitted
        log_std = jnp.full_like(state.params["log_std"], jnp.log(self.std))
        params = {"actor": actor, "critic": critic, "log_std": log_std}
        next_state = state.next_state(
            env_states,
            key,
            params=params,
            optimizer=(actor_optimizer, critic_optimizer),
            target=optax.incremental_update(params, state.target, jnp.float32(TARGET_RATE)),
            ema=self.moving_average(state, params),
        )
        return next_state, {
            "policy_loss": loss,
            "std": jnp.asarray(self.std),
            "gradient_norm": optax.tree.norm(gradient),
            "skipped": skipped,
            "learning_rate": jnp.asarray(self.learning_rate),
            **critic_metrics,
        }

    def collect_gradient(
        self, task: Task, state: TrainState, key: jax.Array
    ) -> tuple[jax.Array, Any, Any, Trajectory]:
        """A rollout, and the gradient of the policy's loss through it.

        The loss is the negative return, averaged over all steps.

        Returns:
            The loss (), its gradient, the environment states after the rollout, and its trajectory,
            without gradients.
        """
        shape = (self.horizon, self.num_envs, task.network.action_size)
        reset_states, noise = draw(task, key, shape)
        split, time_first = split_last(state.env_states), PartitionSpec(None, AXIS)
        of_arguments = SHARED, SHARED, SHARED, SHARED, split, split, time_first
        differentiate = sum_over_devices(type(self).sum_gradient, of_arguments, (split, time_first))
        sums, (env_states, trajectory) = differentiate(
            self, task, state.params, state.target, state.env_states, reset_states, self.std * noise
        )
        loss, gradient = optax.tree.scale(1.0 / (self.num_envs * self.horizon), sums)
        return loss, gradient, env_states, trajectory

    def sum_gradient(
        self,
        task: Task,
        params: Params,
        target: Params,
        states: Any,
        reset_states: Any,
        noise: jax.Array,
    ) -> tuple[tuple[jax.Array, Any], tuple[Any, Trajectory]]:
        """``loss`` and its gradient with respect to the policy, and what else ``loss`` returns.

        A method of its own, because it runs on each device with the environments of that device.
        """
        differentiate = jax.value_and_grad(self.loss, has_aux=True)
        (loss, rest), gradient = differentiate(params, task, target, states, reset_states, noise)
        return (loss, gradient["actor"]), rest

    def loss(
        self,
        params: Params,
        task: Task,
        target: Params,
        states: Any,
        reset_states: Any,
        noise: jax.Array,
    ) -> tuple[jax.Array, tuple[Any, Trajectory]]:
        """The negative return () of a rollout, summed over environments.

        Args:
            params: of policy and critic; the policy's are differentiated.
            task: the environment and the network.
            target: parameters of the target critic.
            states: environment states, n.
            reset_states: the states that an ended episode restarts from.
            noise: (horizon, n, actions) to add to the mean action.

        Returns:
            The loss; the environment states after the rollout and its trajectory.
        """

        def before_step(states: Any) -> Any:
            return scale_and_clip_cotangent(states, self.cotangent_decay, self.cotangent_clip)

        end, trajectory = rollout(task, params, target, states, reset_states, noise, before_step)
        return -self.total_return(trajectory), (end, trajectory)

    def total_return(self, trajectory: Trajectory) -> jax.Array:
        """Discounted return of every environment over a short horizon, summed, ().

        ``sum_t gamma^t r_t``, plus the discounted value where an episode is truncated and at the
        horizon (Xu et al., 2022, eq. 5). After the end of an episode the discounting restarts at 1.
        """

        def one(carry: tuple[jax.Array, jax.Array], step: Trajectory) -> tuple[Any, None]:
            gamma, total = carry
            done, value = step.terminated | step.truncated, self.discount * step.next_value
            reward = self.reward_scale * step.reward
            total = total + gamma * (reward + jnp.where(step.truncated, value, 0.0))
            return (jnp.where(done, 1.0, gamma * self.discount), total), None

        ones = jnp.ones_like(trajectory.reward[0])
        (gamma, total), _ = jax.lax.scan(one, (ones, jnp.zeros_like(ones)), trajectory)
        done = trajectory.terminated[-1] | trajectory.truncated[-1]
        return jnp.sum(total + jnp.where(done, 0.0, gamma * trajectory.next_value[-1]))

    def fit_critic(
        self, task: Task, state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[Any, optax.OptState, Metrics]:
        """Regression of the critic to TD(lambda) targets (Xu et al., 2022, eq. 7).

        Several epochs of minibatches of whole rollouts of an environment; the trajectory has values
        of the target critic.

        Returns:
            The critic's parameters, Adam's state, and metrics.
        """
        targets = td_lambda(trajectory, self.discount, self.td_lambda, self.reward_scale)
        adam = self.make_adam(self.critic_learning_rate)

        def loss(critic: Params, observation: jax.Array, target: jax.Array) -> jax.Array:
            predicted = predict_value(task.network, {**state.params, "critic": critic}, observation)
            chex.assert_equal_shape([predicted, target])
            return jnp.mean((predicted - target) ** 2)

        def step(carry: Any, rows: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
            error, gradient = jax.value_and_grad(loss)(carry[0], *rows)
            return descend(adam, clip(gradient, self.critic_max_grad_norm), carry)[0], error

        start = state.params["critic"], state.optimizer[1]
        data = trajectory.observation, targets
        sizes = (self.critic_epochs, self.critic_minibatches, self.horizon)
        (critic, optimizer), errors = run_epochs(step, start, data, key, *sizes)
        metrics = step_metrics(trajectory, errors[-1].mean(), targets)
        return critic, optimizer, {"value_loss": errors.mean()} | metrics

    def make_adam(self, rate: Scalar) -> optax.GradientTransformation:
        """Adam with a step size."""
        adam = optax.scale_by_adam(b1=self.adam_b1, b2=self.adam_b2)
        return optax.chain(adam, optax.scale(-jnp.asarray(rate)))

    def make_policy_optimizer(self, rate: Scalar) -> optax.GradientTransformation:
        """The policy's optimizer with a step size."""
        if self.optimizer == "adam":
            return self.make_adam(rate)
        return optax.contrib.muon(
            jnp.asarray(rate),
            beta=MUON_BETA,
            adam_b1=self.adam_b1,
            adam_b2=self.adam_b2,
            consistent_rms=MUON_RMS,
        )

    def moving_average(self, state: TrainState, params: Params) -> Params:
        """The exponential moving average of the parameters.

        ``(1 - rate) ema + rate params`` with ``rate = max(ema_rate, 20 / (20 + updates))``: the
        average covers about a twentieth of the updates so far, or less, so that early parameters
        fade.
        """
        rate = jnp.maximum(self.ema_rate, EMA_FRACTION / (EMA_FRACTION + state.update))
        average = optax.incremental_update(params, state.ema, rate)
        return {**average, "log_std": params["log_std"]}
