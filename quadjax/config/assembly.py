"""From a config to the racing environment, which is static, and its traced parameters."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.imports import load_object
from quadjax.core.precision import single_precision
from quadjax.core.traced import as_leaves
from quadjax.race.draws import GROUND_STARTS_FRACTION, Disturbance, Start
from quadjax.race.environment import Race
from quadjax.race.layout import ObservedField
from quadjax.race.observations import make_layout
from quadjax.race.rules import Rules
from quadjax.race.track import Track, inside_turn, make_track, make_tracks
from quadjax.race.types import RaceParams
from quadjax.vehicle import motor
from quadjax.vehicle.battery import Battery, battery_params, limit_estimator
from quadjax.vehicle.constants import replaced
from quadjax.vehicle.estimator import EstimatorParams, estimator_params
from quadjax.vehicle.protocol import Constants, VehicleModel, VehicleParams
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.residual import read_residual


def vehicle_model(config: Config) -> VehicleModel:
    """The vehicle model, with a quaternion and disturbances where the config has them.

    The model ``motor`` always has disturbances, as its observation in the paper.
    """
    base = base_model(config.vehicle.model)
    if config.vehicle.quaternion:
        base = base.with_options(quaternion=True)
    disturbed = (
        config.disturbance != Disturbance()
        or config.observation.disturbance == "estimated"
        or any(key.startswith("disturbance.") for key in config.schedules)
    )
    if base.can_be_disturbed and disturbed:
        base = base.with_options(disturbed=True)
    return base


def make_environment(config: Config) -> Race:
    """The race as a static environment, whose fields select code."""
    vehicle, observed = vehicle_model(config), config.observation
    extra = tuple(
        field for _, field in _user_objects("observation.extra", observed.extra, ObservedField)
    )
    return Race(
        model=vehicle,
        layout=make_layout(vehicle, observed, extra, battery=config.battery is not None),
        integrator=config.vehicle.integrator,
        randomize=config.randomization.drawn
        or any(key.startswith("randomization.") for key in config.schedules),
        population=config.randomization.population,
        user_terms=_user_objects("reward.terms", config.reward.terms),
        user_rules=_user_objects("rules.extra", config.rules.extra),
        report_passes=any(x.by == "pass_rate" for x in config.schedules.values()),
        code_version=object() if _has_user_code(config) else None,
    )


def _has_user_code(config: Config) -> bool:
    """Whether a step calls code of the user, which may read what changes between two trainings."""
    extra = config.observation.extra, config.reward.terms, config.rules.extra
    return ":" in config.vehicle.model or any(extra) or config.network.module is not None


def _user_objects(
    key: str, names: Iterable[str], kind: type | None = None
) -> tuple[tuple[str, Any], ...]:
    """A user's own functions, or objects of a kind, with their names ``module:object``."""
    objects = tuple((name, load_object(name, key)) for name in names)
    for name, item in objects:
        if not (callable(item) if kind is None else isinstance(item, kind)):
            wanted = "a function" if kind is None else "a quadjax.ObservedField"
            raise InputError(f"{key}: {name} is a {type(item).__name__}, expected {wanted}")
    return objects


def _constants(config: Config, values: Mapping[str, float]) -> Constants:
    numbers = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
    return base_model(config.vehicle.model).make_constants(numbers)


def make_vehicle(config: Config) -> VehicleParams:
    """The vehicle's constants and its residual, if it has one, scaled by ``residual_gain``.

    Raises:
        InputError: a residual file that cannot be read.
    """
    vehicle, constants = config.vehicle, _constants(config, config.vehicle.constants)
    if vehicle.residual is None:
        return VehicleParams(constants)
    residual = read_residual(Path(vehicle.residual))
    return VehicleParams(constants, residual.replace(gain=jnp.float32(vehicle.residual_gain)))


def make_params(config: Config) -> RaceParams:
    """Every number of the race in training."""
    vehicle, track = make_vehicle(config), make_track(config.track)
    limits = config.training_limits
    pitch = limits.largest_pitch_deg(vehicle_model(config))
    tracks, limit = None, 0.0
    if config.randomization.tracks is not None:
        tracks, limit = make_tracks(config.randomization.tracks)
    return RaceParams(
        vehicle=vehicle,
        track=track,
        reward=as_leaves(config.reward),
        rules=as_leaves(_rules(config, limit)),
        training_limits=as_leaves(limits.replace(pitch_deg=pitch)),
        start=as_leaves(_start(config, track)),
        disturbance=as_leaves(config.disturbance),
        randomization=as_leaves(config.randomization.replace(tracks=None)),
        tracks=tracks,
        heading=inside_turn(track) if config.start.heading == "inside_turn" else None,
        mismatch=_mismatch(config, vehicle),
        estimator=_estimator(config, vehicle),
        battery=_battery(config, vehicle),
        delay=None if config.vehicle.delay is None else _pair(config.vehicle.delay),
        opaque_true=jnp.asarray(True),
    )


def _rules(config: Config, limit: float) -> Rules:
    """The rules with room for random tracks, which need a position limit of ``limit``, m."""
    rules = config.rules
    if rules.position_limit is None:
        return rules
    return rules.replace(position_limit=max(rules.position_limit, limit))


def _start(config: Config, track: Track) -> Start:
    """The starts; a ``race`` of None is a fraction of a race from the ground, else off."""
    on_ground = track.start is not None and track.start.on_ground
    if config.start.race is None and on_ground:
        return config.start.replace(race=GROUND_STARTS_FRACTION)
    return config.start


def _mismatch(config: Config, vehicle: VehicleParams) -> Constants | None:
    """Factors on the constants of the simulated drone, one for all that are not named."""
    if not config.vehicle.mismatch:
        return None
    ones = jax.tree.map(jnp.ones_like, vehicle.constants)
    return replaced(ones, {k: jnp.float32(x) for k, x in config.vehicle.mismatch.items()})


def _estimator(config: Config, vehicle: VehicleParams) -> EstimatorParams | None:
    """The onboard estimator of the disturbance, where it is observed."""
    model = base_model(config.vehicle.model)
    if config.observation.disturbance != "estimated" or not model.can_be_disturbed:
        return None
    euler = config.vehicle.integrator == "euler"
    return estimator_params(model, vehicle, 1.0 / config.rules.time_step, explicit_euler=euler)


def _pair(ends: tuple[float, float]) -> tuple[jax.Array, jax.Array]:
    """The lowest and highest value of a range."""
    return jnp.float32(ends[0]), jnp.float32(ends[1])


def _battery(config: Config, vehicle: VehicleParams) -> Battery | None:
    """The battery, and the onboard estimator of its limit."""
    if config.battery is None:
        return None
    c, step = vehicle.constants, config.rules.time_step
    return Battery(
        cells=battery_params(config.battery, motor.hover_rpm(c), c.rpm_max),
        charge=_pair(config.battery.charge),
        estimator=limit_estimator(c.rpm_max, c.tau, 1.0 / step),
        time_step=jnp.float32(step),
    )


@single_precision
def make_race(config: Config | Path | str) -> tuple[Race, RaceParams]:
    """The race of a config as an environment of one drone, and every number in it.

    Args:
        config: a config, a preset's name or a YAML file.

    Returns:
        The environment (``reset``, ``observe``, ``step``), and the ``params`` that it takes. With
        ``network.normalize`` or ``observation.critic_constants``, ``quadjax.train`` trains another
        observation: scaled to the default race, or followed by the drawn constants for the critic.
        ``quadjax.training.build.make_training(config)[0].task`` is what it trains.

    Raises:
        InputError: a config or a file of it that cannot be used.
    """
    from quadjax.config.loading import load_config

    config = config if isinstance(config, Config) else load_config(config)
    return make_environment(config), make_params(config)


def leaf_paths(config: Config, key: str) -> tuple[str, ...]:
    """Paths of the leaves, of ``learner`` and of ``params``, that a key of a config sets.

    The onboard estimator of the disturbance has the vehicle's numbers too.
    """
    section, _, rest = key.partition(".")
    part, _, name = rest.partition(".")
    if section != "vehicle":
        return (key if section == "learner" else f"params.{key}",)
    if part == "residual_gain":
        place = "vehicle.residual.gain"
    else:
        model = base_model(config.vehicle.model)
        pairs = jax.tree_util.tree_leaves_with_path(
            model.make_constants({each: each for each in model.constant_names})
        )
        text = {x: jax.tree_util.keystr(path, simple=True, separator=".") for path, x in pairs}
        place = f"{key.removesuffix(name)}{text.get(name, name)}"
    if part == "mismatch":
        return (f"params.{place.removeprefix('vehicle.')}",)
    paths = (f"params.{place}", f"params.estimator.{place}")
    return paths if config.observation.disturbance == "estimated" else paths[:1]
