"""From a config to the racing environment: its static choices and its traced parameters."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config, DisturbanceConfig, TrackConfig
from quadjax.core.vectors import Vec3
from quadjax.race.environment import Choices, RaceParams
from quadjax.race.observation import DisturbanceRange
from quadjax.race.rules import Limits, RewardWeights
from quadjax.race.start import RandomiseFractions, StartRange
from quadjax.race.track import Track, make_track
from quadjax.vehicle.constants import Constants, MotorConstants, RateConstants
from quadjax.vehicle.estimator import EstimatorParams, estimator_params
from quadjax.vehicle.motor import MotorParams
from quadjax.vehicle.rate import RateParams
from quadjax.vehicle.residual_file import read_residual


def choices_of(config: Config) -> Choices:
    """The static part: what chooses code."""
    fractions = vars(config.randomise).values()
    return Choices(
        kind=config.vehicle.kind,
        integrator=config.vehicle.integrator,
        gate_test=config.episode.gate_test,
        random_gate=config.episode.random_gate,
        stagger_clocks=config.episode.stagger_clocks,
        randomise=any(fraction > 0 for fraction in fractions),
        differs=bool(config.vehicle.actual),
        disturbance_input=config.episode.disturbance_input,
    )


def _traced(values: dict[str, float]) -> dict[str, jnp.ndarray]:
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def build_vehicle(config: Config) -> MotorParams | RateParams:
    """The vehicle's constants and its residual, if it has one.

    Raises:
        InputError: a residual file that cannot be read.
    """
    if config.vehicle.kind == "rate":
        return RateParams(RateConstants(**_traced(config.vehicle.rate)))
    path = config.vehicle.residual
    residual = read_residual(Path(path)) if path else None
    return MotorParams(MotorConstants(**_traced(config.vehicle.motor)), residual)


def build_track(track: TrackConfig, wrap_next_yaw: bool = True) -> Track:
    """The track's arrays."""
    return make_track(
        jnp.asarray(np.array([g.position for g in track.gates], np.float32)),
        jnp.asarray(np.radians([g.yaw_deg for g in track.gates]).astype(np.float32)),
        jnp.asarray(np.array([g.size for g in track.gates], np.float32)),
        wrap_next_yaw,
    )


def disturbance_range(section: DisturbanceConfig) -> DisturbanceRange:
    """The disturbances that are drawn, and the steady ones."""
    steady = Vec3(*(jnp.float32(x) for x in section.steady_moment))
    return DisturbanceRange(**_traced(section.half_widths), steady_moment=steady)


def _actual(config: Config, vehicle: MotorParams | RateParams) -> Constants | None:
    """Factors on the constants of the drone that flies, one for all that are not named."""
    if not config.vehicle.actual:
        return None
    ones = jax.tree.map(jnp.ones_like, vehicle.constants)
    return ones.replace(**_traced(config.vehicle.actual))


def _estimator(config: Config, vehicle: MotorParams | RateParams) -> EstimatorParams | None:
    """The onboard estimator of the disturbance, where the observation is to have one."""
    if config.episode.disturbance_input != "estimated" or config.vehicle.kind != "motor":
        return None
    euler = config.vehicle.integrator == "euler"
    return estimator_params(vehicle, 1.0 / config.episode.dt, explicit_euler=euler)


def build_params(config: Config) -> RaceParams:
    """Every number of the race as the config trains it."""
    episode, begin = config.episode, config.start
    limits = {
        "dt": episode.dt,
        "position": episode.position_limit,
        "rate": episode.rate_limit,
        "yaw_rate": episode.yaw_rate_limit if episode.yaw_rate_limit < 1000 else math.inf,
        "pitch": math.radians(episode.pitch_limit_deg),
        "roll": math.radians(episode.roll_limit_deg) if episode.roll_limit_deg < 180 else math.inf,
        "gate_margin": episode.gate_margin,
    }
    ranges = {
        "position": begin.position,
        "velocity": begin.velocity,
        "roll_pitch": math.radians(begin.roll_pitch_deg),
        "yaw": math.radians(begin.yaw_deg),
        "rates": begin.rates,
        "thrust_low": begin.thrust[0],
        "thrust_high": begin.thrust[1],
    }
    vehicle = build_vehicle(config)
    return RaceParams(
        vehicle=vehicle,
        track=build_track(config.track, episode.wrap_next_yaw),
        limits=Limits(**_traced(limits), max_steps=jnp.asarray(episode.max_steps, jnp.int32)),
        reward=RewardWeights(**_traced(vars(config.reward) | {"nose_up": 0.0})),
        start=StartRange(**_traced(ranges)),
        disturbance=disturbance_range(config.disturbance),
        randomise=RandomiseFractions(**_traced(vars(config.randomise))),
        early_nose_up=jnp.asarray(config.train.nose_up_price, jnp.float32),
        actual=_actual(config, vehicle),
        estimator=_estimator(config, vehicle),
    )


def exact_rules(params: RaceParams) -> RaceParams:
    """The same race by its exact rules: no margin, any roll, and pitch up to the singularity."""
    limits = params.limits.replace(
        gate_margin=jnp.zeros(()),
        pitch=jnp.asarray(math.radians(89.0), jnp.float32),
        roll=jnp.asarray(jnp.inf, jnp.float32),
        yaw_rate=jnp.asarray(jnp.inf, jnp.float32),
    )
    return params.replace(limits=limits)
