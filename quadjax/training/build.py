"""From a config to a learner on the racing environment."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import leaf_paths, make_environment, make_params
from quadjax.config.scales import race_scales
from quadjax.config.schema import Config
from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.mlp import Layers, Params, to_layers, to_params
from quadjax.core.traced import as_leaves
from quadjax.learners.loop import Plan
from quadjax.learners.networks import PARTS, ActorCritic, initial_params
from quadjax.learners.schedules import Training
from quadjax.learners.state import Task, TrainState
from quadjax.policy.file import Layers as FileLayers
from quadjax.policy.file import Policy
from quadjax.policy.inference import PolicyParams
from quadjax.policy.own_network import OwnNetwork
from quadjax.policy.pilot import in_scaling_of
from quadjax.race.environment import PrivilegedRace
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.residual import is_shipped, read_residual

# For a program that runs once: 1.8 instead of 2.5 s of CPU time to compile, and the same bits.
QUICK = {"xla_backend_optimization_level": 1}
REFERENCE_LEG_M, REFERENCE_TIME_S = 3.5, 0.43  # of the paper's track and the Bebop 1


def training_environment(config: Config) -> Environment[RaceParams, RaceState]:
    """The race of training. Where the critic observes the drawn constants, they come last."""
    environment, constants = make_environment(config), critic_constants(config)
    return PrivilegedRace(**vars(environment), spread=constants) if constants else environment


def critic_constants(config: Config) -> tuple[tuple[str, float], ...]:
    """The constants that only the critic observes, and how far each is drawn from its value."""
    if not config.observation.critic_constants:
        return ()
    spread = config.randomization.by_constant(base_model(config.vehicle.model))
    every = config.randomization.population is not None
    return tuple((name, size or 1.0) for name, size in spread.items() if size or every)


def make_network(config: Config) -> ActorCritic:
    """The network of a config."""
    return config.network.make(
        training_environment(config).action_size,
        clip_mean=config.learner.noise_on == "clipped_mean",
        privileged_size=len(critic_constants(config)),
    )


def input_scale(config: Config) -> tuple[float, ...]:
    """Factors on the observation in training; (): none.

    With ``network.normalize``, they make lengths, velocities and rates what they are on the track
    and the drone of the default race.
    """
    if not config.network.normalize:
        return ()
    scales = race_scales(config.track, config.vehicle, config.rules.time_step)
    length, time = scales.leg / REFERENCE_LEG_M, scales.time / REFERENCE_TIME_S
    factors = {"m": 1.0 / length, "m/s": time / length, "rad/s": time}
    return tuple(
        factors.get(field.unit, 1.0) if field.scale is None else 1.0
        for field in make_environment(config).layout.fields
        for _ in range(field.size)
    )


def make_training(config: Config) -> tuple[Training, Plan]:
    """The learner of a config on the racing environment, with the schedules of the run.

    Returns:
        What the run repeats, and how its steps are divided.

    Raises:
        InputError: a schedule of a key that sets no number of the run, or a residual file that
            cannot be read.
    """
    scale = input_scale(config)
    factors = jnp.asarray(scale, jnp.float32) if scale else None
    params = make_params(config).replace(observation_scale=factors)
    task = Task.of(training_environment(config), make_network(config), params)
    plan = config.learner.plan(config.run.steps, config.run.evaluate_every)
    return Training(as_leaves(config.learner), task).with_schedules(
        config.schedules,
        functools.partial(leaf_paths, config),
        plan,
        config.run.steps,
        config.curriculum,
    ), plan


def start_state(config: Config, training: Training, initial: Policy | None = None) -> TrainState:
    """A run's first state, with the policy ``initial`` if there is one.

    The target and the moving average of the parameters, where there are any, start from it too.
    """
    init = jax.jit(Training.init, compiler_options=QUICK)
    state = init(training, jax.random.key(config.seed))
    if initial is None:
        return state
    start = with_policy(state.params, initial, reward_scale(config), input_scale(config))
    copies = {
        name: jax.tree.map(jnp.copy, start)
        for name in ("target", "ema")
        if getattr(state, name) is not None
    }
    return dataclasses.replace(state, params=start, **copies)


def reward_scale(config: Config) -> float:
    """The learner's factor on the reward, which is the unit of its values."""
    return getattr(config.learner, "reward_scale", 1.0)


def initial_policy(config: Config) -> Policy | None:
    """The policy of ``run.initial_policy``, if there is one, in the scaling of the config's race.

    Its noise may be on the mean or on the clipped mean: the mean action, clipped, is the same, and
    the config's learner defines where it adds noise.

    Raises:
        InputError: a file that cannot be read, or whose network is not the config's.
    """
    if config.run.initial_policy is None:
        return None
    origin = f"{config.run.initial_policy} (--fine-tune or run.initial_policy)"
    policy, hidden = Policy.load(config.run.initial_policy, config), list(config.network.hidden)
    checks: list[tuple[str, object, object]] = [
        ("network", policy.own.module if policy.own else None, config.network.module),
        ("vehicle", policy.vehicle, base_model(config.vehicle.model).name),
        ("observation", list(policy.layout.names), list(make_environment(config).layout.names)),
        ("activation", policy.activation, config.network.activation),
    ]
    networks = {"hidden widths": policy.layers, "hidden widths of the value": policy.value or ()}
    for name, layers in networks.items():
        if layers:
            checks.append((name, [len(bias) for _, bias in layers[:-1]], hidden))
    for name, value, allowed in checks:
        if value != allowed:
            raise InputError(f"{origin} has {name} {value}, the config has {allowed}")
    return in_scaling_of(make_environment(config), make_params(config), policy, origin)


def with_policy(
    params: Params, policy: Policy, scale: float, inputs: Sequence[float] = ()
) -> Params:
    """Parameters with the policy of a file, and with its value where that has the same inputs.

    Args:
        params: of a network of the policy's widths, or of its class.
        policy: a policy file's content.
        scale: of the reward: the unit of the values.
        inputs: factors on the observation in training; (): none.
    """
    log_std = jnp.asarray(policy.log_std, jnp.float32)
    if policy.own is not None:
        own = jax.tree.map(jnp.asarray, policy.own.params)
        if not _has_critic_of(policy, params["critic"], scale):
            own["critic"] = params["critic"]
        return {**own, "log_std": log_std}
    inverse, critic = [1.0 / x for x in inputs], params["critic"]
    if policy.value is not None and policy.value[0][0].shape == critic["Dense_0"]["kernel"].shape:
        critic = to_params(_rescaled(policy.value, inverse, scale))
    actor = to_params(_rescaled(policy.layers, inverse))
    return {"actor": actor, "critic": critic, "log_std": log_std}


def _has_critic_of(policy: Policy, critic: Params, scale: float) -> bool:
    """Whether a network of the user's own has a critic of the same shapes and unit of values."""
    own = policy.own.params.get("critic") if policy.own else None
    learner = (policy.config or {}).get("learner", {})
    shapes = [jax.tree.map(np.shape, tree) for tree in (own, critic)]
    return shapes[0] == shapes[1] and learner.get("reward_scale", 1.0) == scale


def _rescaled(layers: Layers, inputs: Sequence[float] = (), output: float = 1.0) -> Layers:
    """A network's layers with its inputs multiplied by ``inputs`` and its outputs by ``output``."""
    new_layers = [(jnp.asarray(kernel), jnp.asarray(bias)) for kernel, bias in layers]
    if inputs:
        kernel, bias = new_layers[0]
        new_layers[0] = (jnp.asarray(inputs, jnp.float32)[:, None] * kernel, bias)
    if output != 1.0:
        kernel, bias = new_layers[-1]
        new_layers[-1] = (output * kernel, output * bias)
    return tuple(new_layers)


def network_policy(config: Config, params: Params) -> PolicyParams:
    """A network in training for inference."""
    actor, inputs = params["actor"], input_scale(config)
    if inputs:
        actor = to_params(_rescaled(to_layers(actor), inputs))
    network = make_network(config).clone(privileged_size=0)
    return PolicyParams({"actor": actor, "log_std": params["log_std"]}, network)


def first_params(config: Config, seed: int) -> Params:
    """Initial parameters of the network of a config."""
    size = training_environment(config).observation_size
    return initial_params(make_network(config), jax.random.key(seed), size)


def untrained_policy(config: Config) -> Policy:
    """A policy with random weights for the race of a config."""
    return make_policy(config, first_params(config, config.seed))


def trained_policy(config: Config, params: Params, steps: int) -> Policy:
    """A network after a number of environment steps of a training as a policy."""
    source = {
        "project": "quadjax",
        "config": config.name,
        "algorithm": config.learner.algorithm,
        "seed": config.seed,
        "residual": config.vehicle.residual,
        "steps": steps,
    }
    return make_policy(config, params, source)


def make_policy(config: Config, params: Params, source: dict[str, Any] | None = None) -> Policy:
    """A network in training as a policy."""
    environment = make_environment(config)
    model = environment.model
    constants = model.make_constants(config.vehicle.constants)
    low, high = (np.array(jax.tree.leaves(end)) for end in model.command_range(constants))
    layers, value, own = _parts_of_policy(config, jax.device_get(params))
    residual = config.vehicle.residual
    return Policy(
        layers=layers,
        log_std=np.asarray(params["log_std"]),
        vehicle=model.name,
        activation=config.network.activation,
        noise_on=config.learner.noise_on,
        command_low=low,
        command_high=high,
        layout=environment.layout.with_spans(model, make_params(config)),
        source=source or {},
        value=value,
        config=config.model_dump(mode="json", by_alias=True),
        residual=read_residual(residual) if residual and not is_shipped(residual) else None,
        own=own,
    )


def _parts_of_policy(
    config: Config, params: Params
) -> tuple[FileLayers, FileLayers | None, OwnNetwork | None]:
    """The layers of the policy and of the value in plain units, or the network of the user's own.

    A critic that observes more than the policy is left out.
    """
    if config.network.module is not None:
        network = make_network(config).clone(privileged_size=0)
        parts = {name: params[name] for name in PARTS[: 1 if critic_constants(config) else 2]}
        return (), None, OwnNetwork(config.network.module, parts, network)
    inputs, value = input_scale(config), None
    if not critic_constants(config):
        value = _rescaled(to_layers(params["critic"]), inputs, 1.0 / reward_scale(config))
    layers = _rescaled(to_layers(params["actor"]), inputs)
    return jax.device_get(layers), jax.device_get(value), None
