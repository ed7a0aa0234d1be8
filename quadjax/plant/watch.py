"""The navigation filter on known flights: its errors against its own standard deviations."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3
from quadjax.plant import ekf, flights, sensors
from quadjax.plant.ekf_params import EkfParams, ekf_params
from quadjax.plant.estimate import Belief, estimate
from quadjax.plant.flights import Plan, Seen, Setting
from quadjax.plant.sensor_schema import NavigationConfig
from quadjax.plant.sensors import SensorParams, sensor_params
from quadjax.plant.truth import Truth

WITHIN = 3.0  # standard deviations
LOST = {"position": 0.5, "euler": 0.5, "velocity": 2.0}  # m, rad, m/s: a filter that diverged
COMPONENTS = tuple(item.name for item in dataclasses.fields(Belief))


@struct.dataclass
class Onboard:
    """Parameters of what a drone carries."""

    sensors: SensorParams
    ekf: EkfParams


@struct.dataclass
class Tally:
    """How the errors of one flight compare with their own standard deviations."""

    samples: jax.Array  # () float32, exact below 2^24
    inside: Belief  # samples within three standard deviations
    squares: Belief  # sums of squared errors
    ratios: Belief  # sums of squared errors over variances
    worst: Belief  # largest error over its standard deviation
    lost: jax.Array  # () bool: diverged, or not finite
    error: Belief  # of the last sample
    std: Belief  # of the last sample


@struct.dataclass
class Watched:
    """Sensors, filter and tally of one drone."""

    sensors: sensors.SensorState
    ekf: ekf.EkfState
    tally: Tally


@dataclasses.dataclass(frozen=True)
class Result:
    """What came out; arrays are (7, 3): components of ``Belief`` by axes."""

    flights: int
    whole: int  # flights that did not crash
    hours: float  # of flight
    inside: np.ndarray  # share of the samples within three standard deviations
    rmse: np.ndarray
    ratio: np.ndarray  # mean square of error over standard deviation; 1 for a filter that is right
    worst: np.ndarray  # largest error over its standard deviation
    diverged: int  # flights

    def to_json(self) -> dict[str, object]:
        """As JSON takes it."""
        values = vars(self)
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def onboard_of(config: NavigationConfig, sample_rate: float, gravity: float = 9.81) -> Onboard:
    """Sensors and filter of a config.

    Raises:
        InputError: a value that cannot be.
    """
    return Onboard(
        sensor_params(config.sensors, sample_rate),
        ekf_params(config.sensors, config.ekf, sample_rate, gravity),
    )


def start(onboard: Onboard, truth: Truth, drawn: jax.Array) -> Watched:
    """Sensors and filter of one drone at its first sample, (START_DRAWS,) normal numbers."""
    carried, measured = sensors.init(onboard.sensors, truth, drawn)
    zero = jnp.zeros(())
    none = Belief(*(Vec3(zero, zero, zero) for _ in COMPONENTS))
    tally = Tally(zero, none, none, none, none, jnp.zeros((), bool), none, none)
    return Watched(carried, ekf.init(onboard.ekf, measured), tally)


def watch(onboard: Onboard, watched: Watched, seen: Seen, drawn: jax.Array) -> Watched:
    """One drone's next sample: sensors, filter, and how far off it is."""
    carried, measured = sensors.update(onboard.sensors, watched.sensors, seen.truth, drawn)
    believed = ekf.update(onboard.ekf, watched.ekf, measured)
    now = estimate(onboard.ekf, believed)
    error = errors_of(now.value, seen.truth, carried)
    return Watched(carried, believed, _count(watched.tally, error, now.std, seen.over))


def errors_of(value: Belief, truth: Truth, carried: sensors.SensorState) -> Belief:
    """Estimated less true, angles within half a turn."""
    euler = value.euler - truth.euler
    return Belief(
        value.position - truth.position,
        value.velocity - truth.velocity,
        Vec3(*(wrap_angle(angle) for angle in euler.components())),
        value.rates - truth.rates,
        value.specific_force - truth.specific_force,
        value.gyro_bias - carried.gyro.bias,
        value.accelerometer_bias - carried.accelerometer.bias,
    )


def _count(tally: Tally, error: Belief, std: Belief, over: jax.Array) -> Tally:
    ratio = jax.tree.map(lambda e, s: jnp.abs(e) / jnp.maximum(s, 1e-12), error, std)
    squared = jax.tree.map(jnp.square, error)

    def add(total: Belief, values: Belief) -> Belief:
        return jax.tree.map(lambda t, v: t + jnp.where(over, 0.0, v), total, values)

    near = jnp.ones((), bool)  # a number that is none is not near either
    for name, limit in LOST.items():
        near &= sum(getattr(squared, name).components()) <= limit * limit
    return Tally(
        tally.samples + jnp.where(over, 0.0, 1.0),
        add(tally.inside, jax.tree.map(lambda r: (r <= WITHIN).astype(r.dtype), ratio)),
        add(tally.squares, squared),
        add(tally.ratios, jax.tree.map(jnp.square, ratio)),
        jax.tree.map(lambda w, r: jnp.where(over, w, jnp.maximum(w, r)), tally.worst, ratio),
        tally.lost | (~near & ~over),
        error,
        std,
    )


@jax.jit
def start_all(onboard: Onboard, truth: Truth, key: jax.Array) -> Watched:
    """``start`` for drones along the last axis."""
    drawn = jax.random.normal(key, (sensors.START_DRAWS, truth.position.x.shape[-1]))
    return jax.vmap(start, (None, -1, -1), -1)(onboard, truth, drawn)


@functools.partial(jax.jit, donate_argnums=1)
def watch_all(onboard: Onboard, watched: Watched, seen: Seen, key: jax.Array) -> Watched:
    """``watch`` over samples along the first axis, for drones along the last."""
    each = jax.vmap(watch, (None, -1, -1, -1), -1)

    def one(watched: Watched, now: tuple[Seen, jax.Array]) -> tuple[Watched, None]:
        seen, key = now
        drawn = jax.random.normal(key, (sensors.DRAWS, seen.over.shape[-1]))
        return each(onboard, watched, seen, drawn), None

    keys = jax.random.split(key, seen.over.shape[0])
    return jax.lax.scan(one, watched, (seen, keys))[0]


def judge(
    plan: Plan,
    setting: Setting,
    config: NavigationConfig,
    advance: Callable[[int], None] = lambda steps: None,
) -> Result:
    """Fly, measure, filter and count.

    Args:
        plan: the flights.
        setting: what the plan was made of.
        config: sensors and filter.
        advance: called with the number of control steps flown since the last call.

    Raises:
        InputError: a value that cannot be.
    """
    gravity = float(plan.params.vehicle.constants.g)
    onboard = onboard_of(config, plan.sample_rate, gravity)
    key = jax.random.key(setting.seed)
    under_way, truth = flights.begin(plan, setting)
    watched = start_all(onboard, truth, jax.random.fold_in(key, 0))
    flown = 0
    while flown < plan.control_steps:
        steps = min(50, plan.control_steps - flown)
        flown += steps
        of_policy, of_sensors = jax.random.split(jax.random.fold_in(key, flown))
        under_way, seen = flights.fly_on(plan, under_way, of_policy, steps)
        watched = jax.block_until_ready(watch_all(onboard, watched, seen, of_sensors))
        advance(steps)
    return _result(watched.tally, np.asarray(under_way.over), plan.sample_rate)


def _result(tally: Tally, over: np.ndarray, sample_rate: float) -> Result:
    def of(belief: Belief) -> np.ndarray:  # (7, 3, flights)
        vectors = (getattr(belief, name).components() for name in COMPONENTS)
        return np.array([[np.asarray(x, np.float64) for x in vector] for vector in vectors])

    total = np.asarray(tally.samples, np.float64).sum()
    return Result(
        flights=over.size,
        whole=int((~over).sum()),
        hours=total / sample_rate / 3600.0,
        inside=of(tally.inside).sum(axis=-1) / total,
        rmse=np.sqrt(of(tally.squares).sum(axis=-1) / total),
        ratio=of(tally.ratios).sum(axis=-1) / total,
        worst=of(tally.worst).max(axis=-1),
        diverged=int(np.asarray(tally.lost).sum()),
    )
