"""From a config to the racing environment: its static choices and its traced parameters."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config, DisturbanceConfig, TrackConfig
from quadjax.core.environment import Environment
from quadjax.core.vectors import Vec3
from quadjax.race.environment import Choices, RaceParams, make_environment
from quadjax.race.layout import make_layout
from quadjax.race.rules import Limits, RewardWeights
from quadjax.race.start import DisturbanceRange, RandomiseFractions, StartRange
from quadjax.race.track import Track, make_track
from quadjax.vehicle.estimator import EstimatorParams, estimator_params
from quadjax.vehicle.protocol import Constants, VehicleParams
from quadjax.vehicle.registry import model
from quadjax.vehicle.residual_file import read_residual


def choices_of(config: Config) -> Choices:
    """The static part: what chooses code."""
    fractions = vars(config.randomise).values()
    vehicle = model(config.vehicle.kind)
    source = config.episode.disturbance_input
    return Choices(
        model=vehicle,
        layout=make_layout(
            vehicle,
            "ground_truth" if source == "true" else source,
            config.episode.wrap_next_yaw,
        ),
        integrator=config.vehicle.integrator,
        gate_test=config.episode.gate_test,
        random_gate=config.episode.random_gate,
        stagger_clocks=config.episode.stagger_clocks,
        randomise=any(fraction > 0 for fraction in fractions),
        differs=bool(config.vehicle.actual),
    )


def _traced(values: dict[str, float]) -> dict[str, jnp.ndarray]:
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def build_vehicle(config: Config) -> VehicleParams:
    """The vehicle's constants and its residual, if it has one.

    Raises:
        InputError: a residual file that cannot be read.
    """
    own = model(config.vehicle.kind)
    path = config.vehicle.residual if own.has_residual else None
    residual = read_residual(Path(path)) if path else None
    return VehicleParams(own.constants(**_traced(getattr(config.vehicle, own.name))), residual)


def build_track(track: TrackConfig) -> Track:
    """The track's arrays."""
    return make_track(
        jnp.asarray(np.array([g.position for g in track.gates], np.float32)),
        jnp.asarray(np.radians([g.yaw_deg for g in track.gates]).astype(np.float32)),
        jnp.asarray(np.array([g.size for g in track.gates], np.float32)),
    )


def disturbance_range(section: DisturbanceConfig) -> DisturbanceRange:
    """The disturbances that are drawn, and the steady ones."""
    steady = Vec3(*(jnp.float32(x) for x in section.steady_moment))
    return DisturbanceRange(**_traced(section.half_widths), steady_moment=steady)


def _actual(config: Config, vehicle: VehicleParams) -> Constants | None:
    """Factors on the constants of the drone that flies, one for all that are not named."""
    if not config.vehicle.actual:
        return None
    ones = jax.tree.map(jnp.ones_like, vehicle.constants)
    return ones.replace(**_traced(config.vehicle.actual))


def _estimator(config: Config, vehicle: VehicleParams) -> EstimatorParams | None:
    """The onboard estimator of the disturbance, where the observation is to have one."""
    own = model(config.vehicle.kind)
    if config.episode.disturbance_input != "estimated" or own.balance is None:
        return None
    euler = config.vehicle.integrator == "euler"
    return estimator_params(own, vehicle, 1.0 / config.episode.dt, explicit_euler=euler)


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
        track=build_track(config.track),
        limits=Limits(**_traced(limits), max_steps=jnp.asarray(episode.max_steps, jnp.int32)),
        reward=RewardWeights(**_traced(vars(config.reward) | {"nose_up": 0.0})),
        start=StartRange(**_traced(ranges)),
        disturbance=disturbance_range(config.disturbance),
        randomise=RandomiseFractions(**_traced(vars(config.randomise))),
        early_nose_up=jnp.asarray(config.train.nose_up_price, jnp.float32),
        actual=_actual(config, vehicle),
        estimator=_estimator(config, vehicle),
    )


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

    own = config if isinstance(config, Config) else load_config(config)
    return make_environment(choices_of(own)), build_params(own)
