"""From a config to a learner on the racing environment."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.learners.hyper import as_leaves
from quadjax.learners.loop import plan_chunks
from quadjax.learners.networks import ActorCritic, Networks, layers_of, tree_of
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.schedules import make_schedule, with_schedules
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.state import Learner, TrainState
from quadjax.policy.file import Policy
from quadjax.policy.inference import Flying
from quadjax.race.build import build_params, choices_of
from quadjax.race.environment import RaceParams, make_environment
from quadjax.training.curriculum import curriculum_of, follow


def build_networks(config: Config) -> Networks:
    """The networks of a config."""
    environment = make_environment(choices_of(config))
    return Networks(
        observation_size=environment.observation_size,
        action_size=environment.action_size,
        hidden=tuple(config.network.hidden),
        activation=config.network.activation,
        clip_mean=noise_on(config) == "clipped_mean",
    )


def noise_on(config: Config) -> str:
    """Where a learner's noise goes, as a policy file says it: ``mean`` or ``clipped_mean``.

    PPO's goes on the network's own output, which may be far beyond the limits: there the noise does
    nothing, which lets a policy be sure. SHAC's noise is set, not learned: it goes on the clipped
    mean, so that exploring never ends at a limit. Each learns much worse the other way round.
    """
    return "clipped_mean" if config.algorithm == "shac" else "mean"


def build_learner(config: Config) -> Learner[RaceParams]:
    """The learner of a config, on the racing environment, with its schedules."""
    environment, networks = make_environment(choices_of(config)), build_networks(config)
    first, last = _sections(config)
    updates, chunks = plan(config, first.make(environment, networks, 1).steps_per_update)
    num_updates = updates * chunks
    learner = first.make(environment, networks, num_updates, config.train.shares)
    schedules = {}
    if first != last:
        params = build_params(config)
        trees = [(as_leaves(section), params) for section in (first, last)]
        steps = [0.0, num_updates * learner.steps_per_update]
        schedules = {"learner": make_schedule("learner", steps, trees, learner.steps_per_update)}
    return with_schedules(follow(learner, curriculum_of(config)), schedules)


def _sections(config: Config) -> tuple[PPO | SHAC, PPO | SHAC]:
    """Hyperparameters at the start and at the end of a run."""
    drones = config.train.drones
    if config.algorithm == "ppo":
        c = config.ppo
        first = PPO(
            num_envs=drones,
            rollout_length=c.steps_per_update,
            num_minibatches=c.batches,
            num_epochs=c.epochs,
            shuffle_block=c.shuffle_block or None,
            learning_rate=c.learning_rate,
            adam_epsilon=c.adam_epsilon,
            discount=c.discount,
            gae_lambda=c.gae_lambda,
            clip_range=c.clip,
            value_coefficient=c.value_coefficient,
            entropy_coefficient=c.entropy_coefficient,
            max_grad_norm=c.gradient_norm,
            separate_grad_clip=c.separate_clip,
            max_kl=c.kl_limit,
            reward_scale=c.reward_scale,
            critic_warmup=c.warm_up,
            initial_log_std=config.network.log_std,
        )
        return first, first.replace(learning_rate=c.final_learning_rate)
    c = config.shac
    first = SHAC(
        num_envs=drones,
        horizon=c.horizon,
        learning_rate=c.learning_rate,
        adam_b1=c.adam_b1,
        adam_b2=c.adam_b2,
        max_grad_norm=c.gradient_norm,
        critic_learning_rate=c.critic_learning_rate,
        critic_max_grad_norm=c.critic_gradient_norm,
        critic_epochs=c.critic_passes,
        critic_minibatches=c.critic_batches,
        target_update_rate=c.critic_target_rate,
        td_lambda=c.td_lambda,
        discount=c.discount,
        cotangent_decay=c.state_gradient_decay,
        cotangent_clip=c.state_gradient_clip,
        std=c.std,
        reward_scale=c.reward_scale,
        ema_rate=c.mean_rate,
        critic_warmup=c.warm_up,
    )
    single = np.float32
    critic = single(c.critic_learning_rate) * single(c.final_learning_rate)
    last = first.replace(
        learning_rate=c.final_learning_rate,
        critic_learning_rate=float(critic / single(c.learning_rate)),
        std=c.final_std,
        discount=c.discount if c.final_discount is None else c.final_discount,
    )
    return first, last


def plan(config: Config, steps_per_update: int) -> tuple[int, int]:
    """Updates of one chunk, and chunks of the whole run: whole numbers, each at least one.

    A run of fewer steps than ``train.evaluate_every`` is one short chunk.
    """
    return plan_chunks(config.train.steps, config.train.evaluate_every, steps_per_update)


def start_state(
    config: Config, learner: Learner, params: RaceParams, initial: Policy | None = None
) -> TrainState:
    """A run's first state, with the policy ``initial`` if there is one."""
    state = jax.jit(learner.init)(learner.hyper, params, jax.random.key(config.seed))
    if initial is None:
        return state
    return with_params(state, with_policy(state.params, initial, reward_scale(config)))


def with_params(state: TrainState, params: ActorCritic) -> TrainState:
    """The state with other networks, which its target and its moving average start from."""
    copies = {
        name: jax.tree.map(jnp.copy, params)
        for name in ("target", "ema")
        if getattr(state, name) is not None
    }
    return state.replace(params=params, **copies)


def reward_scale(config: Config) -> float:
    """What the learner multiplies the reward by: the unit of its values."""
    return (config.ppo if config.algorithm == "ppo" else config.shac).reward_scale


def initial_policy(config: Config) -> Policy | None:
    """The policy of ``train.init``, if there is one.

    Raises:
        InputError: a file that cannot be read, or whose network is not the config's.
    """
    if config.train.init is None:
        return None
    policy = Policy.load(config.train.init)
    widths = [int(kernel.shape[1]) for kernel, _ in policy.layers[:-1]]
    wanted = list(config.network.hidden)
    judge = wanted if policy.value is None else [int(k.shape[1]) for k, _ in policy.value[:-1]]
    for name, found, allowed in (
        ("vehicle", policy.vehicle, config.vehicle.kind),
        ("hidden widths", widths, wanted),
        ("hidden widths of the value", judge, wanted),
        ("activation", policy.activation, config.network.activation),
    ):
        if found != allowed:
            raise InputError(
                f"train.init: {config.train.init} has {name} {found}, the config {allowed}"
            )
    return policy


def with_policy(params: ActorCritic, policy: Policy, scale: float) -> ActorCritic:
    """Parameters whose policy is that of a file, and so is the value where the file has it.

    Args:
        params: of networks of the policy's widths.
        policy: a policy file's content.
        scale: of the reward: the unit of the values.
    """
    log_std = jnp.asarray(policy.log_std, jnp.float32)
    value = params.value
    if policy.value is not None:
        value = tree_of(_scaled(policy.value, scale))
    return params.replace(policy=tree_of(list(policy.layers)), log_std=log_std, value=value)


def _scaled(layers: Sequence[tuple], factor: float) -> list[tuple]:
    """The layers of a network whose outputs are ``factor`` times as large."""
    kernel, bias = layers[-1]
    return [*layers[:-1], (factor * kernel, factor * bias)]


def flying_of(params: ActorCritic, activation: str) -> Flying:
    """Networks in training as a policy in flight."""
    return Flying(tuple(layers_of(params.policy)), params.log_std, activation)


def policy_of(config: Config, params: ActorCritic, source: dict[str, Any]) -> Policy:
    """Networks in training as a policy."""
    choices = choices_of(config)
    model = choices.model
    constants = model.constants(**getattr(config.vehicle, model.name))
    low, high = (np.array(jax.tree.leaves(end)) for end in model.command_range(constants))
    value = _scaled(layers_of(params.value), 1.0 / reward_scale(config))
    return Policy(
        layers=tuple((np.asarray(k), np.asarray(b)) for k, b in layers_of(params.policy)),
        log_std=np.asarray(params.log_std),
        vehicle=model.name,
        activation=config.network.activation,
        noise_on=noise_on(config),
        command_low=low,
        command_high=high,
        layout=choices.layout.with_spans(model, build_params(config)),
        source=source,
        value=tuple((np.asarray(k), np.asarray(b)) for k, b in value),
        config=dataclasses.asdict(config),
    )
