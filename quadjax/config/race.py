"""From a config to the racing environment: its static choices and its traced parameters."""

import functools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config import schema
from quadjax.config.schema import Config, Disturbance
from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.imports import load_object
from quadjax.core.sections import Section
from quadjax.core.vectors import Vec3
from quadjax.race.battery import RaceBattery
from quadjax.race.environment import Choices, RaceParams, make_environment
from quadjax.race.layout import Field, make_layout
from quadjax.race.random_track import RandomTracks, generate
from quadjax.race.rules import Frame, Landing, Limits, Overspeed, Perception, RewardWeights
from quadjax.race.start import DisturbanceRange, StartRange
from quadjax.race.track import Pose, Track, inside_turn, make_track
from quadjax.vehicle import motor
from quadjax.vehicle.battery import battery_params, limit_estimator
from quadjax.vehicle.constants import replaced
from quadjax.vehicle.estimator import EstimatorParams, estimator_params
from quadjax.vehicle.protocol import Constants, VehicleModel, VehicleParams
from quadjax.vehicle.registry import model
from quadjax.vehicle.residual import scale_residual
from quadjax.vehicle.residual_file import read_residual

FROM_GROUND = 0.1  # default part of the episodes that begin on the ground, where races do
APART = ("terms", "perception_deg", "camera_deg", "overspeed", "overspeed_margin")
OPTIONAL = ("action_change", "perception")  # penalties that are computed where they are used


def vehicle_model_of(config: Config) -> VehicleModel:
    """The vehicle model, with a quaternion and disturbances where the config has them."""
    own = model(config.vehicle.model)
    if config.vehicle.quaternion:
        own = own.with_options(quaternion=True)
    disturbed = (
        config.disturbance != Disturbance()
        or config.observation.disturbance == "estimated"
        or any(key.startswith("disturbance.") for key in config.schedules)
    )
    if own.can_be_disturbed and disturbed:
        own = own.with_options(disturbed=True)
    return own


def choices_of(config: Config) -> Choices:
    """The static part, which selects code."""
    vehicle = vehicle_model_of(config)
    observed, start = config.observation, config.start
    extra, past = _own("observation.extra", observed.extra, Field), observed.history
    unobserved = observed.highest_rpm == "none"
    return Choices(
        model=vehicle,
        layout=make_layout(
            vehicle,
            observed.disturbance,
            observed.wrap_next_yaw,
            extra,
            observed.attitude,
            observed.gates_ahead,
            observed.last_action,
            observed.actuator_range,
            None if config.battery is None or unobserved else observed.highest_rpm,
            *((), ()) if past is None else (past.fields, past.lags),
            observed.actuators,
            observed.constants,
        ),
        integrator=config.vehicle.integrator,
        gate_test=config.rules.gate_test,
        random_gate=start.gate == "random",
        stagger_clocks=start.stagger_clocks,
        randomize=config.randomization.drawn
        or any(key.startswith("randomization.") for key in config.schedules),
        population=config.randomization.population,
        mismatch=bool(config.vehicle.mismatch),
        terms=_own("reward.terms", config.reward.terms),
        rules=_own("rules.extra", config.rules.extra),
        report_passes=any(each.by == "pass_rate" for each in config.schedules.values()),
    )


def _own(key: str, names: Iterable[str], kind: type | None = None) -> tuple[Any, ...]:
    """A user's own functions, or objects of a kind, named as ``module:object``."""
    found = tuple(load_object(name, key) for name in names)
    for name, each in zip(names, found, strict=True):
        if not (callable(each) if kind is None else isinstance(each, kind)):
            wanted = "a function" if kind is None else f"a {kind.__name__}"
            raise InputError(f"{key}: {name} is a {type(each).__name__}, expected {wanted}")
    return found


def _traced(values: dict[str, float]) -> dict[str, jnp.ndarray]:
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def build_vehicle(config: Config) -> VehicleParams:
    """The vehicle's constants and its residual, if it has one, scaled by ``residual_gain``.

    Raises:
        InputError: a residual file that cannot be read.
    """
    vehicle = config.vehicle
    constants = model(vehicle.model).make_constants(_traced(vehicle.constants))
    if vehicle.residual is None:
        return VehicleParams(constants)
    residual = read_residual(Path(vehicle.residual))
    if vehicle.residual_gain != 1.0:
        residual = scale_residual(residual, jnp.float32(vehicle.residual_gain))
    return VehicleParams(constants, residual)


def build_track(track: schema.Track) -> Track:
    """The track's arrays."""
    tilt = np.radians([(g.roll_deg, g.pitch_deg) for g in track.gates]).astype(np.float32)
    circle = np.array([g.shape == "circle" for g in track.gates])
    return make_track(
        jnp.asarray(np.array([g.position for g in track.gates], np.float32)),
        jnp.asarray(np.radians([g.yaw_deg for g in track.gates]).astype(np.float32)),
        jnp.asarray(np.array([g.size for g in track.gates], np.float32)),
        jnp.asarray(tilt) if tilt.any() else None,
        jnp.asarray(circle) if circle.any() else None,
        None if track.start is None else _pose(track.start),
        track.closed,
    )


@functools.lru_cache(maxsize=4)
def build_tracks(settings: RandomTracks) -> tuple[Track, float]:
    """Random tracks as one, with (tracks, gates) of each number, and their position limit, m.

    Raises:
        InputError: settings for which no track was found.
    """
    trees = [generate(own) for own in settings.each]
    tracks = [build_track(schema.Track(gates=tree["gates"])) for tree in trees]
    limit = max(tree["rules"]["position_limit"] for tree in trees)
    return jax.tree.map(lambda *each: jnp.stack(each), *tracks), limit


def _pose(start: schema.TrackStart) -> Pose:
    on_ground = start.position[2] == 0
    return Pose(_vector(start.position), jnp.float32(math.radians(start.yaw_deg)), on_ground)


def _vector(values: Iterable[float]) -> Vec3:
    return Vec3(*(jnp.float32(x) for x in values))


def disturbance_range(section: Disturbance) -> DisturbanceRange:
    """The half-widths of the drawn disturbances, and the constant moment."""
    return DisturbanceRange(
        **_traced(section.half_widths), moment_bias=_vector(section.moment_bias)
    )


def _mismatch(config: Config, vehicle: VehicleParams) -> Constants | None:
    """Factors on the constants of the simulated drone, one for all that are not named."""
    if not config.vehicle.mismatch:
        return None
    ones = jax.tree.map(jnp.ones_like, vehicle.constants)
    return replaced(ones, _traced(config.vehicle.mismatch))


def _estimator(config: Config, vehicle: VehicleParams) -> EstimatorParams | None:
    """The onboard estimator of the disturbance, where it is observed."""
    own = model(config.vehicle.model)
    if config.observation.disturbance != "estimated" or not own.can_be_disturbed:
        return None
    euler = config.vehicle.integrator == "euler"
    return estimator_params(own, vehicle, 1.0 / config.rules.time_step, explicit_euler=euler)


def _battery(config: Config, vehicle: VehicleParams) -> RaceBattery | None:
    """The battery, and the onboard estimator of its limit."""
    if config.battery is None:
        return None
    c, step = vehicle.constants, config.rules.time_step
    low, high = config.battery.charge
    return RaceBattery(
        cells=battery_params(config.battery, motor.hover_rpm(c)),
        charge=(jnp.float32(low), jnp.float32(high)),
        estimator=limit_estimator(c.rpm_max, c.tau, 1.0 / step),
        time_step=jnp.float32(step),
    )


def build_params(config: Config) -> RaceParams:
    """Every number of the race in training."""
    own, vehicle = model(config.vehicle.model), build_vehicle(config)
    track = build_track(config.track)
    inside = config.start.heading == "inside_turn"
    tracks, limits = None, _limits(config)
    if config.randomization.tracks is not None:
        tracks, limit = build_tracks(config.randomization.tracks)
        limits = limits.replace(position=jnp.maximum(limits.position, limit))
    return RaceParams(
        vehicle=vehicle,
        track=track,
        tracks=tracks,
        limits=limits,
        reward=_reward(config),
        start=_start_range(config.start).replace(
            heading=inside_turn(track) if inside else None,
            race=_race_part(config.start.race, track),
        ),
        disturbance=disturbance_range(config.disturbance),
        randomization=own.make_constants(_traced(config.randomization.by_constant(own))),
        population_width=_population_width(config),
        mismatch=_mismatch(config, vehicle),
        estimator=_estimator(config, vehicle),
        battery=_battery(config, vehicle),
        term_weights=tuple(jnp.float32(weight) for weight in config.reward.terms.values()),
    )


def _reward(config: Config) -> RewardWeights:
    """The weights; penalties that need more computation only where they are not zero."""
    own = config.reward
    used = {key for key in OPTIONAL if getattr(own, key) or f"reward.{key}" in config.schedules}
    sight = {
        "weight": own.perception,
        "camera": math.radians(own.camera_deg),
        "limit": math.radians(own.perception_deg),
    }
    return RewardWeights(
        **_traced(_without(own, *APART, *OPTIONAL)),
        action_change=jnp.float32(own.action_change) if "action_change" in used else None,
        overspeed=_overspeed(config),
        perception=Perception(**_traced(sight)) if "perception" in used else None,
    )


def _overspeed(config: Config) -> Overspeed | None:
    limit, own = config.rules.speed_limit, config.reward
    if limit is None:
        return None
    numbers = {"weight": own.overspeed, "limit": limit, "margin": own.overspeed_margin}
    return Overspeed(**_traced(numbers))


def _population_width(config: Config) -> jax.Array | None:
    own = config.randomization
    return None if own.population is None else jnp.float32(own.width)


def _without(section: Section, *names: str) -> dict[str, float]:
    return {key: value for key, value in section.__dict__.items() if key not in names}


def _limits(config: Config) -> Limits:
    rules, training = config.rules, config.training_limits
    limits = {
        "time_step": rules.time_step,
        "position": _or_none(rules.position_limit),
        "body_rate": max(rules.largest_body_rates),
        "yaw_rate": _or_none(training.yaw_rate),
        "pitch": math.radians(
            _or_none(config.training_limits.largest_pitch_deg(vehicle_model_of(config)))
        ),
        "roll": math.radians(_or_none(training.roll_deg)),
        "gate_inflation": training.gate_inflation,
    }
    steps = jnp.asarray(training.episode_steps, jnp.int32)
    by_axis = isinstance(rules.body_rate_limit, tuple)
    box, solid = rules.bounds, {"width": rules.gate_frame, "depth": rules.gate_depth}
    return Limits(
        **_traced(limits),
        episode_steps=steps,
        axis_rates=_vector(rules.largest_body_rates) if by_axis else None,
        bounds=None if box is None else (_vector(x[0] for x in box), _vector(x[1] for x in box)),
        landing=_landing(rules),
        frame=Frame(**_traced(solid)) if rules.gate_frame else None,
        body_radius=jnp.float32(rules.body_radius) if rules.body_radius else None,
        speed=None if rules.speed_limit is None else jnp.float32(rules.speed_limit),
    )


def _landing(rules: schema.Rules) -> Landing | None:
    if rules.ground_speed is None:
        return None
    return Landing(**_traced({"height": rules.ground_height, "speed": rules.ground_speed}))


def _or_none(limit: float | None) -> float:
    """A limit; infinity where there is none."""
    return math.inf if limit is None else limit


def _start_range(start: schema.Start) -> StartRange:
    ranges = {
        "position": start.position,
        "velocity": start.velocity,
        "roll_pitch": math.radians(start.roll_pitch_deg),
        "yaw": math.radians(start.yaw_deg),
        "rates": start.body_rates,
        "thrust_low": start.thrust[0],
        "thrust_high": start.thrust[1],
    }
    part = jnp.float32(start.along_leg) if start.along_leg > 0 else None
    return StartRange(**_traced(ranges), along_leg=part)


def _race_part(part: float | None, track: Track) -> jax.Array | None:
    """The part of the episodes that begin as a race; None: none."""
    if part is None:
        part = FROM_GROUND if track.start is not None and track.start.on_ground else 0.0
    return jnp.float32(part) if part > 0.0 else None


def race_of(config: Config) -> tuple[Choices, RaceParams]:
    """The race of a config: its static choices, and every number in it."""
    return choices_of(config), build_params(config)


def make_race(config: Config | Path | str) -> tuple[Environment, RaceParams]:
    """The race of a config as three pure functions of one drone, and every number in them.

    Args:
        config: a config, a preset's name or a YAML file.

    Returns:
        The environment (``reset``, ``observe``, ``step``), and the ``params`` that it takes.

    Raises:
        InputError: a config or a file of it that cannot be used.
    """
    from quadjax.config.loading import load_config

    choices, params = race_of(config if isinstance(config, Config) else load_config(config))
    return make_environment(choices), params
