"""From a config to a learner on the racing environment."""

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.errors import InputError
from quadjax.learn.networks import ActorCritic, Networks, layers_of, tree_of
from quadjax.learn.ppo import update as ppo
from quadjax.learn.shac import update as shac
from quadjax.learn.state import Learner, TrainState
from quadjax.policies import Flying
from quadjax.policy_file import Policy, read_policy
from quadjax.race.build import choices_of
from quadjax.race.environment import RaceParams, make_environment
from quadjax.schema import Config


def _leaves(kind: type, section: object) -> object:
    return kind(**{name: jnp.float32(getattr(section, name)) for name in kind.__dataclass_fields__})


def build_networks(config: Config) -> Networks:
    """The networks of a config."""
    environment = make_environment(choices_of(config))
    return Networks(
        observation_size=environment.observation_size,
        action_size=environment.action_size,
        hidden=tuple(config.network.hidden),
        activation=config.network.activation,
        log_std=config.network.log_std,
    )


def build_learner(config: Config) -> Learner[RaceParams]:
    """The learner of a config, on the racing environment."""
    environment, networks = make_environment(choices_of(config)), build_networks(config)
    drones = config.train.drones
    if config.algorithm == "ppo":
        section = config.ppo
        structure = ppo.Structure(
            environments=drones,
            steps=section.steps_per_update,
            batches=section.batches,
            epochs=section.epochs,
            updates=_updates(config, section.steps_per_update),
            shuffle_block=section.shuffle_block,
            separate_clip=section.separate_clip,
        )
        return ppo.make_learner(environment, networks, structure, _leaves(ppo.Hyper, section))
    section = config.shac
    structure = shac.Structure(
        environments=drones,
        horizon=section.horizon,
        critic_passes=section.critic_passes,
        critic_batches=section.critic_batches,
        updates=_updates(config, section.horizon),
    )
    return shac.make_learner(environment, networks, structure, _leaves(shac.Hyper, section))


def _updates(config: Config, steps: int) -> int:
    return max(1, config.train.steps // (config.train.drones * steps))


def start_state(config: Config, learner: Learner, params: RaceParams) -> TrainState:
    """A run's first state; its policy is that of ``train.init``, if there is one."""
    state = jax.jit(learner.init)(params, jax.random.key(config.seed))
    if config.train.init is None:
        return state
    policy = read_policy(config.train.init)
    return state.replace(params=with_policy(config, state.params, policy))


def with_policy(config: Config, params: ActorCritic, policy: Policy) -> ActorCritic:
    """Fresh parameters whose policy is that of a file.

    Raises:
        InputError: the file's network is not the config's.
    """
    widths = [int(kernel.shape[1]) for kernel, _ in policy.layers[:-1]]
    wanted = list(config.network.hidden)
    for name, found, allowed in (
        ("vehicle", policy.vehicle, config.vehicle.kind),
        ("hidden widths", widths, wanted),
        ("activation", policy.activation, config.network.activation),
        ("output", policy.output, "clip"),
    ):
        if found != allowed:
            raise InputError(
                f"train.init: {config.train.init} has {name} {found}, the config {allowed}"
            )
    log_std = jnp.asarray(policy.log_std, jnp.float32)
    return params.replace(policy=tree_of(list(policy.layers)), log_std=log_std)


def flying_of(params: ActorCritic, activation: str) -> Flying:
    """Networks in training as a policy in flight."""
    return Flying(tuple(layers_of(params.policy)), params.log_std, activation)


def policy_of(config: Config, params: ActorCritic, source: dict) -> Policy:
    """Networks in training as a policy file's content."""
    vehicle = config.vehicle
    if vehicle.kind == "motor":
        low, high = [vehicle.motor["rpm_min"]] * 4, [vehicle.motor["rpm_max"]] * 4
    else:
        rates = [vehicle.rate[name] for name in ("p_max", "q_max", "r_max")]
        low = [-x for x in rates] + [vehicle.rate["thrust_min"]]
        high = rates + [vehicle.rate["thrust_max"]]
    ranges = {"disturbance": config.disturbance.half_widths} if vehicle.kind == "motor" else {}
    return Policy(
        layers=tuple((np.asarray(k), np.asarray(b)) for k, b in layers_of(params.policy)),
        log_std=np.asarray(params.log_std),
        vehicle=vehicle.kind,
        activation=config.network.activation,
        output="clip",
        command_low=np.array(low),
        command_high=np.array(high),
        observation={
            "wrap_next_yaw": config.episode.wrap_next_yaw,
            "disturbance_input": config.episode.disturbance_input,
            **ranges,
        },
        source=source,
    )
