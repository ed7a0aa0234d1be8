"""A pilot that needs no training, random policies, and laps that were not flown."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import make_environment, make_params
from quadjax.config.loading import load_config
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.race.layout import Layout
from quadjax.race.observation_config import PUBLISHED, Observation
from quadjax.race.observations import DISTURBANCES, make_layout
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import MODELS
from tests.race.support import BLANK

GRAVITY = 9.81
HIGH = np.array([3.0, 3.0, 3.0, 15.0])
LOW = np.array([-3.0, -3.0, -3.0, 0.0])


def flights(*totals: float, laps: int = 2, before: int = 0, reason: str = "hit a gate") -> Laps:
    """Flights of equal laps, s; NaN for one that ends early, after ``before`` laps of 2.5 s."""
    times = np.array(totals)[:, None] / laps * np.ones(laps)
    times[np.isnan(times[:, 0]), :before] = 2.5
    crashes = tuple("" if np.isfinite(x) else reason for x in totals)
    return Laps(times, crashes, np.nansum(times, axis=1), 8.0 * laps)


def rate_race(*overrides: str):
    config = load_config(BLANK, ["vehicle.model=rate", *overrides])
    return config, make_environment(config), make_params(config)


def script(speed: float = 2.5, offset: float = 0.0, thrust: float = 1.0, pitch_rate: float = 0.0):
    """What the pilot does: speed through the gates, m/s, and how far to their right, m."""
    numbers = {"speed": speed, "offset": offset, "thrust": thrust, "pitch_rate": pitch_rate}
    return {name: jnp.float32(value) for name, value in numbers.items()}


def scripted(wish: dict, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """Acceleration towards the gate's axis, then the attitude and the rates that give it."""
    _, y, z, vx, vy, vz, roll, pitch, yaw = observation[:9]
    ahead = jnp.clip(3.0 * (wish["speed"] - vx), -4.0, 4.0)
    right = jnp.clip(6.0 * (wish["offset"] - y) - 4.0 * vy, -5.0, 5.0)
    down = jnp.clip(-8.0 * z - 5.0 * vz, -4.0, 4.0)
    forward = jnp.cos(yaw) * ahead + jnp.sin(yaw) * right
    sideways = -jnp.sin(yaw) * ahead + jnp.cos(yaw) * right
    thrust = (GRAVITY - down) / (jnp.cos(roll) * jnp.cos(pitch))
    wanted_pitch, wanted_roll = -forward / GRAVITY, sideways / GRAVITY
    rates = [8.0 * (wanted_roll - roll), 8.0 * (wanted_pitch - pitch), -3.0 * yaw]
    rates[1] = jnp.where(wish["pitch_rate"] != 0.0, wish["pitch_rate"], rates[1])
    command = jnp.stack([*rates, thrust * wish["thrust"]])
    return 2.0 * (command - LOW) / (HIGH - LOW) - 1.0


def layout_of_file(
    model: VehicleModel,
    command_range: tuple[np.ndarray, np.ndarray],
    widths: dict[str, float] | None = None,
    observed: Observation = PUBLISHED,
) -> Layout:
    """The layout of a file; ``widths`` are those that scale the observed disturbances."""
    ends = zip(*(end.tolist() for end in command_range), strict=True)
    spans = {model.actuators.name: tuple(ends)[-model.actuators.size :]}
    if widths is not None:
        for field, names in DISTURBANCES.items():
            half = [widths.get(name, 0.0) for name in names]
            spans[field] = tuple((-width, width) for width in half)
    return Layout(
        tuple(
            dataclasses.replace(field, value=None, span=spans.get(field.name))
            for field in make_layout(model, observed).fields
        )
    )


def random_policy(
    vehicle: str = "motor",
    widths: dict[str, float] | None = None,
    observed: Observation = PUBLISHED,
    **changes: object,
) -> Policy:
    random = np.random.default_rng(0)
    inputs = {"motor": 24, "rate": 17}[vehicle]
    shapes = ((inputs, 8), (8, 4))
    layers = tuple((0.3 * random.normal(size=s), 0.1 * random.normal(size=s[1])) for s in shapes)
    low, high = (np.full(4, 3000.0), np.full(4, 11000.0)) if vehicle == "motor" else (LOW, HIGH)
    low, high = changes.get("command_low", low), changes.get("command_high", high)
    values = {
        "layers": layers,
        "log_std": np.full(4, -1.0),
        "vehicle": vehicle,
        "activation": "relu",
        "command_low": low,
        "command_high": high,
        "layout": layout_of_file(MODELS[vehicle], (low, high), widths, observed),
    }
    return Policy(**(values | changes))
