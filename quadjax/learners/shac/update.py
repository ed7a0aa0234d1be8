"""One update of short-horizon actor-critic (Xu et al., 2022).

1. ``collect_gradient`` simulates all environments over a short horizon, and differentiates their
   discounted return through the simulator.
2. ``_policy_step`` moves the policy along this gradient.
3. ``fit_critic`` fits the value to TD(lambda) targets of the same steps.

A target critic and the moving average that is evaluated follow the parameters.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec

from quadjax.core.environment import Environment, vectorize
from quadjax.core.gradients import Scalar, scale_and_clip_cotangent
from quadjax.core.traced import as_leaves, register
from quadjax.learners.minibatches import clip, descend, run_epochs
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.parallel import AXIS, SHARED, split_last, sum_over_devices
from quadjax.learners.rollout import Steps, draw, rollout, step_metrics, td_lambda
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.state import Learner, Metrics, TrainState

EMA_FRACTION = 20.0  # the moving average covers about one part in 20 of the updates so far

register(SHAC)


def make_learner(environment: Environment, networks: Networks, hyper: SHAC) -> Learner:
    """SHAC on a differentiable environment; arguments as of ``SHAC.make``."""
    batched = vectorize(environment)
    return Learner(
        init=functools.partial(_init, batched, networks),
        update=functools.partial(_update, batched, networks),
        hyper=as_leaves(hyper),
        steps_per_update=hyper.num_envs * hyper.horizon,
    )


def _adam(hyper: SHAC, rate: Scalar) -> optax.GradientTransformation:
    adam = optax.scale_by_adam(b1=hyper.adam_b1, b2=hyper.adam_b2)
    return optax.chain(adam, optax.scale(-jnp.asarray(rate)))


def _init(
    environment: Environment, networks: Networks, hyper: SHAC, env_params: Any, key: jax.Array
) -> TrainState:
    network_key, reset_key, key = jax.random.split(key, 3)
    params = networks.init(network_key)
    params = dataclasses.replace(params, log_std=jnp.full_like(params.log_std, jnp.log(hyper.std)))
    adam = _adam(hyper, 0.0)
    return TrainState(
        params=params,
        optimizer=(adam.init(params.policy), adam.init(params.value)),
        target=jax.tree.map(jnp.copy, params),
        environment=environment.reset(env_params, jax.random.split(reset_key, hyper.num_envs)),
        key=key,
        update=jnp.zeros((), jnp.int32),
        ema=jax.tree.map(jnp.copy, params),
    )


def _update(
    environment: Environment, networks: Networks, hyper: SHAC, env_params: Any, state: TrainState
) -> tuple[TrainState, Metrics]:
    key, rollout_key, shuffle_key = jax.random.split(state.key, 3)
    loss, gradient, environment_state, steps = collect_gradient(
        environment, networks, hyper, env_params, state, rollout_key
    )
    policy, policy_optimizer, policy_metrics = _policy_step(hyper, state, gradient)
    value, value_optimizer, critic_metrics = fit_critic(networks, hyper, state, steps, shuffle_key)
    log_std = jnp.full_like(state.params.log_std, jnp.log(hyper.std))
    params = ActorCritic(policy=policy, log_std=log_std, value=value)
    following = dataclasses.replace(
        state,
        params=params,
        optimizer=(policy_optimizer, value_optimizer),
        target=optax.incremental_update(params, state.target, hyper.target_update_rate),
        environment=environment_state,
        key=key,
        update=state.update + 1,
        ema=_moving_average(hyper, state, params),
    )
    metrics = {"policy_loss": loss, "std": jnp.asarray(hyper.std)}
    return following, metrics | policy_metrics | critic_metrics


def collect_gradient(
    environment: Environment,
    networks: Networks,
    hyper: SHAC,
    env_params: Any,
    state: TrainState,
    key: jax.Array,
) -> tuple[jax.Array, Any, Any, Steps]:
    """A rollout, and the gradient of the policy's loss through it.

    The loss is the negative return, averaged over all steps.

    Returns:
        The loss (), its gradient, the environment states after the rollout, and its steps, without
        gradients.
    """
    shape = (hyper.horizon, hyper.num_envs, networks.action_size)
    fresh, noise = draw(environment, env_params, key, shape)

    def differentiate(
        hyper: SHAC,
        env_params: Any,
        params: ActorCritic,
        target: ActorCritic,
        state: Any,
        fresh: Any,
        noise: jax.Array,
    ) -> tuple[Any, Any]:
        """The sums over environments of loss and gradient; states and steps."""

        def through(state: Any) -> Any:
            return scale_and_clip_cotangent(state, hyper.cotangent_decay, hyper.cotangent_clip)

        def loss(policy: Any) -> tuple[jax.Array, tuple[Any, Steps]]:
            actor = dataclasses.replace(params, policy=policy)
            end, steps = rollout(
                environment, networks, env_params, actor, target, state, fresh, noise, through
            )
            return -total_return(steps, hyper), (end, steps)

        (value, rest), gradient = jax.value_and_grad(loss, has_aux=True)(params.policy)
        return (value, gradient), rest

    split, time_first = split_last(state.environment), PartitionSpec(None, AXIS)
    specs = (SHARED, SHARED, SHARED, SHARED, split, split, time_first)
    gradient_of = sum_over_devices(differentiate, specs, (split, time_first))
    sums, (environment_state, steps) = gradient_of(
        hyper, env_params, state.params, state.target, state.environment, fresh, hyper.std * noise
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


def _policy_step(
    hyper: SHAC, state: TrainState, gradient: Any
) -> tuple[Any, optax.OptState, Metrics]:
    """One step of Adam on the policy; a gradient that is not finite changes nothing.

    While the critic warms up the policy stays as it is, and Adam's moments are updated.
    """
    rate = jnp.where(state.update < hyper.critic_warmup, 0.0, hyper.learning_rate)
    carry = (state.params.policy, state.optimizer[0])
    clipped = clip(gradient, hyper.max_grad_norm)
    (policy, optimizer), skipped = descend(_adam(hyper, rate), clipped, carry)
    return (
        policy,
        optimizer,
        {
            "gradient_norm": optax.tree.norm(gradient),
            "skipped": skipped,
            "learning_rate": jnp.asarray(hyper.learning_rate),
        },
    )


def fit_critic(
    networks: Networks, hyper: SHAC, state: TrainState, steps: Steps, key: jax.Array
) -> tuple[Any, optax.OptState, Metrics]:
    """Regression of the critic to TD(lambda) targets (Xu et al., 2022, eq. 7).

    Several epochs of minibatches of whole trajectories.

    Args:
        networks: the policy and the value.
        hyper: hyperparameters.
        state: its critic is fitted further.
        steps: the data, with values of the target critic.
        key: PRNG key of the order.

    Returns:
        The critic's parameters, Adam's state, and metrics.
    """
    targets = td_lambda(steps, hyper.discount, hyper.td_lambda, hyper.reward_scale)
    adam = _adam(hyper, hyper.critic_learning_rate)

    def loss(value: Any, observation: jax.Array, target: jax.Array) -> jax.Array:
        predicted = networks.value(dataclasses.replace(state.params, value=value), observation)
        return jnp.mean((predicted - target) ** 2)

    def step(carry: Any, rows: tuple[jax.Array, jax.Array]) -> tuple[Any, Metrics]:
        error, gradient = jax.value_and_grad(loss)(carry[0], *rows)
        carry, _ = descend(adam, clip(gradient, hyper.critic_max_grad_norm), carry)
        return carry, {"value_loss": error}

    start = (state.params.value, state.optimizer[1])
    data = (steps.observation, targets)
    sizes = (hyper.critic_epochs, hyper.critic_minibatches, hyper.horizon)
    (value, optimizer), metrics = run_epochs(step, start, data, key, *sizes)
    errors = metrics["value_loss"]
    metrics = {"value_loss": errors.mean()} | step_metrics(steps, errors[-1].mean(), targets)
    return value, optimizer, metrics


def _moving_average(hyper: SHAC, state: TrainState, params: ActorCritic) -> ActorCritic:
    """The exponential moving average of the parameters.

    ``(1 - rate) ema + rate params`` with ``rate = max(ema_rate, 20 / (20 + updates))``: the average
    covers about a twentieth of the updates so far, or less, so that early parameters fade.
    """
    rate = jnp.maximum(hyper.ema_rate, EMA_FRACTION / (EMA_FRACTION + state.update))
    average = optax.incremental_update(params, state.ema, rate)
    return dataclasses.replace(average, log_std=params.log_std)
