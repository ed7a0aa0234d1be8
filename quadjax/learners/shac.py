"""Short-horizon actor-critic (Xu et al., 2022): its hyperparameters and its update.

1. ``collect_gradient`` simulates all environments over a short horizon, and differentiates their
   discounted return through the simulator.
2. A step of Adam or Muon moves the policy along this gradient, if it is finite.
3. ``fit_critic`` fits the value to TD(lambda) targets of the same steps.

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

from quadjax.core.environment import Environment
from quadjax.core.gradients import Scalar, scale_and_clip_cotangent
from quadjax.core.mlp import Params
from quadjax.core.sections import Field, Fraction, Positive, Unit, model_validator
from quadjax.core.traced import register
from quadjax.learners.networks import ActorCritic, predict_value
from quadjax.learners.parallel import AXIS, SHARED, split_last, sum_over_devices
from quadjax.learners.rollout import (
    Steps,
    Task,
    bind,
    clip,
    descend,
    draw,
    first_state,
    rollout,
    run_epochs,
    step_metrics,
    td_lambda,
)
from quadjax.learners.section import (
    Count,
    Discount,
    LearnerSection,
    NumEnvs,
    RewardScale,
    check_divisor,
)
from quadjax.learners.state import Learner, Metrics, TrainState

TARGET_RATE = 0.2  # part of the distance to the critic that its target moves in an update
MUON_BETA = 0.9  # decay of the momentum of Muon
MUON_RMS = 0.8  # root mean square of an orthogonal step of a matrix, in learning rates
EMA_FRACTION = 20.0  # the moving average covers about one part in 20 of the updates so far


@register
class SHAC(LearnerSection):
    """Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""

    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "clipped_mean"

    algorithm: Literal["shac"] = Field("shac", description="short-horizon actor-critic")
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

    def make(self, environment: Environment, network: ActorCritic, num_updates: int) -> Learner:
        """The learner on a differentiable environment; see ``LearnerSection.make``."""
        return bind(self, self.horizon, environment, network, _init, _update)


def _adam(hyper: SHAC, rate: Scalar) -> optax.GradientTransformation:
    adam = optax.scale_by_adam(b1=hyper.adam_b1, b2=hyper.adam_b2)
    return optax.chain(adam, optax.scale(-jnp.asarray(rate)))


def make_policy_optimizer(hyper: SHAC, rate: Scalar) -> optax.GradientTransformation:
    """The optimizer of ``hyper`` with a step size."""
    if hyper.optimizer == "adam":
        return _adam(hyper, rate)
    return optax.contrib.muon(
        jnp.asarray(rate),
        beta=MUON_BETA,
        adam_b1=hyper.adam_b1,
        adam_b2=hyper.adam_b2,
        consistent_rms=MUON_RMS,
    )


def _init(task: Task, hyper: SHAC, key: jax.Array) -> TrainState:
    state = first_state(task, key, hyper.num_envs, jnp.log(hyper.std))
    params, adam, optimizer = state.params, _adam(hyper, 0.0), make_policy_optimizer(hyper, 0.0)
    return dataclasses.replace(
        state,
        optimizer=(optimizer.init(params["actor"]), adam.init(params["critic"])),
        target=jax.tree.map(jnp.copy, params),
        ema=jax.tree.map(jnp.copy, params),
    )


def _update(task: Task, hyper: SHAC, state: TrainState) -> tuple[TrainState, Metrics]:
    key, rollout_key, shuffle_key = jax.random.split(state.key, 3)
    loss, gradient, environment_state, steps = collect_gradient(task, hyper, state, rollout_key)
    optimizer = make_policy_optimizer(hyper, hyper.learning_rate)
    carry = (state.params["actor"], state.optimizer[0])
    (actor, actor_optimizer), skipped = descend(
        optimizer, clip(gradient, hyper.max_grad_norm), carry
    )
    critic, critic_optimizer, critic_metrics = fit_critic(task, hyper, state, steps, shuffle_key)
    log_std = jnp.full_like(state.params["log_std"], jnp.log(hyper.std))
    params = {"actor": actor, "critic": critic, "log_std": log_std}
    following = state.following(
        environment_state,
        key,
        params=params,
        optimizer=(actor_optimizer, critic_optimizer),
        target=optax.incremental_update(params, state.target, jnp.float32(TARGET_RATE)),
        ema=_moving_average(hyper, state, params),
    )
    return following, {
        "policy_loss": loss,
        "std": jnp.asarray(hyper.std),
        "gradient_norm": optax.tree.norm(gradient),
        "skipped": skipped,
        "learning_rate": jnp.asarray(hyper.learning_rate),
        **critic_metrics,
    }


def collect_gradient(
    task: Task, hyper: SHAC, state: TrainState, key: jax.Array
) -> tuple[jax.Array, Any, Any, Steps]:
    """A rollout, and the gradient of the policy's loss through it.

    The loss is the negative return, averaged over all steps.

    Returns:
        The loss (), its gradient, the environment states after the rollout, and its steps, without
        gradients.
    """
    shape = (hyper.horizon, hyper.num_envs, task.network.action_size)
    fresh, noise = draw(task, key, shape)

    def differentiate(shared: Any, states: Any, noise: jax.Array) -> tuple[Any, Any]:
        """The sums over environments of loss and gradient; states and steps."""
        (hyper, env_params, params, target_critic), (state, fresh) = shared, states
        here = dataclasses.replace(task, env_params=env_params)

        def through(state: Any) -> Any:
            return scale_and_clip_cotangent(state, hyper.cotangent_decay, hyper.cotangent_clip)

        def loss(actor: Params) -> tuple[jax.Array, tuple[Any, Steps]]:
            policy = {**params, "actor": actor}
            end, steps = rollout(here, policy, target_critic, state, fresh, noise, through)
            return -total_return(steps, hyper), (end, steps)

        (value, rest), gradient = jax.value_and_grad(loss, has_aux=True)(params["actor"])
        return (value, gradient), rest

    split, time_first = split_last(state.environment), PartitionSpec(None, AXIS)
    specs, results = (SHARED, (split, split), time_first), (split, time_first)
    shared = (hyper, task.env_params, state.params, state.target)
    sums, (environment_state, steps) = sum_over_devices(differentiate, specs, results)(
        shared, (state.environment, fresh), hyper.std * noise
    )
    loss, gradient = optax.tree.scale(1.0 / (hyper.num_envs * hyper.horizon), sums)
    return loss, gradient, environment_state, steps


def total_return(steps: Steps, hyper: SHAC) -> jax.Array:
    """Discounted return of every environment over a short horizon, summed, ().

    ``sum_t gamma^t r_t``, plus the discounted value where an episode is truncated and at the
    horizon (Xu et al., 2022, eq. 5). After the end of an episode the discounting restarts at 1.
    """

    def one(carry: tuple[jax.Array, jax.Array], step: Steps) -> tuple[Any, None]:
        gamma, total = carry
        done, value = step.terminated | step.truncated, hyper.discount * step.next_value
        reward = hyper.reward_scale * step.reward
        total = total + gamma * (reward + jnp.where(step.truncated, value, 0.0))
        return (jnp.where(done, 1.0, gamma * hyper.discount), total), None

    ones = jnp.ones_like(steps.reward[0])
    (gamma, total), _ = jax.lax.scan(one, (ones, jnp.zeros_like(ones)), steps)
    done = steps.terminated[-1] | steps.truncated[-1]
    return jnp.sum(total + jnp.where(done, 0.0, gamma * steps.next_value[-1]))


def fit_critic(
    task: Task, hyper: SHAC, state: TrainState, steps: Steps, key: jax.Array
) -> tuple[Any, optax.OptState, Metrics]:
    """Regression of the critic to TD(lambda) targets (Xu et al., 2022, eq. 7).

    Several epochs of minibatches of whole trajectories; ``steps`` have values of the target critic.

    Returns:
        The critic's parameters, Adam's state, and metrics.
    """
    targets = td_lambda(steps, hyper.discount, hyper.td_lambda, hyper.reward_scale)
    adam = _adam(hyper, hyper.critic_learning_rate)

    def loss(critic: Params, observation: jax.Array, target: jax.Array) -> jax.Array:
        predicted = predict_value(task.network, {**state.params, "critic": critic}, observation)
        chex.assert_equal_shape([predicted, target])
        return jnp.mean((predicted - target) ** 2)

    def step(carry: Any, rows: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        error, gradient = jax.value_and_grad(loss)(carry[0], *rows)
        return descend(adam, clip(gradient, hyper.critic_max_grad_norm), carry)[0], error

    start, data = (state.params["critic"], state.optimizer[1]), (steps.observation, targets)
    sizes = (hyper.critic_epochs, hyper.critic_minibatches, hyper.horizon)
    (critic, optimizer), errors = run_epochs(step, start, data, key, *sizes)
    metrics = {"value_loss": errors.mean()} | step_metrics(steps, errors[-1].mean(), targets)
    return critic, optimizer, metrics


def _moving_average(hyper: SHAC, state: TrainState, params: Params) -> Params:
    """The exponential moving average of the parameters.

    ``(1 - rate) ema + rate params`` with ``rate = max(ema_rate, 20 / (20 + updates))``: the average
    covers about a twentieth of the updates so far, or less, so that early parameters fade.
    """
    rate = jnp.maximum(hyper.ema_rate, EMA_FRACTION / (EMA_FRACTION + state.update))
    average = optax.incremental_update(params, state.ema, rate)
    return {**average, "log_std": params["log_std"]}
