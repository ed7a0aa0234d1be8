"""Flights of a Bebop with scaled constants by the float64 reference model, as columns of a log."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.mlp import to_layers, to_params
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.formats import paparazzi_columns
from quadjax.vehicle.residual import Residual
from tests import reference as ref

SECONDS, RATE = 8.0, 250.0
TOGETHER = 8  # flights, one for each seed
NOISE = {
    "rpm": 20.0,
    "gyro": 0.01,
    "acceleration": 0.2,
    "velocity": 0.02,
    "angle": 0.002,
    "exact": 0.0,
}
LEVEL = np.sqrt(0.5)  # of the noise: of the density that these have at 500 Hz
SPANS = np.array([1.0] * 4 + [8.0] * 3 + [6.0] * 3)  # of a residual's inputs, both signs


def random_residual(seed: int, thrust: float = 1.0, moments=0.015, width: int = 32) -> Residual:
    """A random residual with outputs of some standard deviations, m/s^2 and N m, and no mean."""
    random = np.random.default_rng(seed)

    def network(spans, spread):
        kernel = random.normal(size=(len(spans), width)) / np.sqrt(len(spans))
        bias = random.uniform(-1.0, 1.0, size=width)
        hidden = np.maximum(
            random.uniform(-1.0, 1.0, size=(20_000, len(spans))) @ kernel + bias, 0.0
        )
        last = random.normal(size=(width, len(spread)))
        last = last * spread / np.maximum((hidden @ last).std(axis=0), 1e-12)
        layers = ((kernel / spans[:, None], bias), (last, -(hidden @ last).mean(axis=0)))
        return jax.tree.map(lambda values: jnp.asarray(values, jnp.float32), layers)

    networks = network(SPANS[:7], np.array([thrust])), network(SPANS, np.broadcast_to(moments, 3))
    return Residual(*map(to_params, networks), *map(jnp.float32, (3000.0, 11000.0, 1.0)))


def as_reference(residual: Residual) -> dict:
    """A residual as ``tests.reference`` takes it."""
    values = vars(residual) | {x: to_layers(getattr(residual, x)) for x in ("thrust", "moment")}
    return {key: jax.tree.map(np.float64, value) for key, value in values.items()}


def runge_kutta(slope, x: np.ndarray, dt: float, k1: np.ndarray) -> np.ndarray:
    """States (k, 22) one step later; ``k1`` is the slope at ``x``."""
    k2 = slope(x + 0.5 * dt * k1)
    k3 = slope(x + 0.5 * dt * k2)
    k4 = slope(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def wandering(random: np.random.Generator) -> np.ndarray:
    """Targets (n, 4) for roll, pitch, yaw, rad, and climb, m/s: a few sines each."""
    time = np.arange(int(SECONDS * RATE))[:, None] / RATE
    size, targets = np.array([0.5, 0.5, 0.7, 1.5]), np.zeros((len(time), 4))
    for low, high, weight in ((0.15, 0.5, 0.7), (0.5, 1.2, 0.5), (1.2, 2.5, 0.3)):
        frequency = random.uniform(low, high, 4)
        phase = random.uniform(0.0, 2.0 * np.pi, 4)
        targets += weight * size * np.sin(2.0 * np.pi * frequency * time + phase)
    # Long turns to either side; only these excite yaw damping.
    swing = random.uniform(0.03, 0.06)
    targets[:, 2] += 4.0 / swing / 10.0 * np.sin(2.0 * np.pi * swing * time[:, 0])
    return targets


def _commands(c, residual, x, target):
    """Rpm commands (k, 4) that follow target angles and a climb; a residual is compensated."""
    hover = np.sqrt(c["g"] / (4.0 * c["k_w"]))
    inertia = np.array([c["i_xx"], c["i_yy"], c["i_zz"]])
    effect = np.array([8.0 * c["k_p"] * hover, 8.0 * c["k_q"] * hover, 4.0 * c["k_r1"]]) / inertia
    wanted = [60.0, 60.0, 6.0] * (target[:, :3] - x[:, ref.EULER])
    wanted -= [12.0, 12.0, 4.0] * x[:, ref.RATES]
    body_velocity = ref.rotate(np.swapaxes(ref.rotation(x[:, ref.EULER]), 1, 2), x[:, ref.V])
    extra = ref.residual_terms(residual, x[:, ref.RPM], body_velocity, x[:, ref.RATES])[1]
    roll, pitch, yaw = np.clip((wanted - extra / inertia) / effect, -1200.0, 1200.0).T
    tilt = np.clip(np.cos(x[:, 6]) * np.cos(x[:, 7]), 0.5, 1.0)
    lift = hover / np.sqrt(tilt) + 400.0 * (target[:, 3] + x[:, 5])  # z down
    mix = (roll + pitch - yaw, -roll + pitch + yaw, -roll - pitch - yaw, roll - pitch + yaw)
    return np.clip(lift[:, None] + np.stack(mix, axis=1), c["rpm_min"], c["rpm_max"])


@functools.cache
def _flown(first, residual, factors):
    """States (n, k, 22), commands (n, k, 4), forces (n, k, 3) of flights of consecutive seeds."""
    c = ref.MOTOR | {name: factor * ref.MOTOR[name] for name, factor in factors}
    own = as_reference(random_residual(*residual))
    seeds = range(first, first + TOGETHER)
    targets = np.stack([wandering(np.random.default_rng(seed)) for seed in seeds], axis=1)
    x, dt, record = np.zeros((TOGETHER, 22)), 1.0 / RATE, []
    x[:, ref.RPM] = np.sqrt(c["g"] / (4.0 * c["k_w"]))

    for target in targets:
        u = _commands(c, own, x, target)

        def slope(x, u=u):
            return ref.motor_derivative(c, x, u, own)

        k1, to_body = slope(x), np.swapaxes(ref.rotation(x[:, ref.EULER]), 1, 2)
        record.append((x, u, ref.rotate(to_body, k1[:, ref.V] - [0.0, 0.0, c["g"]])))
        x = runge_kutta(slope, x, dt, k1)
    return [np.stack(values) for values in zip(*record, strict=True)]


@functools.cache
def simulated(seed, residual=(0, 0.0, 0.0), noise=LEVEL, **factors):
    """The columns, each (2000,), of a flight of a Bebop with scaled constants; not to be changed.

    Args:
        seed: of the flight and the noise.
        residual: arguments of ``random_residual``; one of zeros is the nominal model.
        noise: factor on the standard deviations of the sensors.
        factors: of constants, by name.
    """
    first = seed - seed % TOGETHER
    flown = _flown(first, residual, tuple(factors.items()))
    states, commands, forces = (values[:, seed - first] for values in flown)
    random = np.random.default_rng(seed)
    wandering(random)
    bias = np.broadcast_to(random.normal(scale=0.1, size=3), forces.shape)

    def noisy(values, sensor):
        return values + noise * NOISE.get(sensor, 0.0) * random.normal(size=values.shape)

    return paparazzi_columns(
        {
            "time": np.arange(len(states)) / RATE,
            "mode": np.ones(len(states)),
            "position": noisy(states[:, ref.P], ""),
            "world_velocity": noisy(states[:, ref.V], "velocity"),
            "euler": noisy(states[:, ref.EULER], "angle"),
            "gyro": noisy(states[:, ref.RATES], "gyro"),
            "rpm": noisy(states[:, ref.RPM], "rpm"),
            "rpm_command": noisy(commands, ""),
            "acceleration": noisy(forces, "acceleration") + bias,
            "acceleration_bias": bias,
        }
    )


def first_seconds(columns: dict[str, np.ndarray], seconds: float) -> dict[str, np.ndarray]:
    """The beginning of a flight."""
    return {name: values[: round(seconds * RATE)] for name, values in columns.items()}


def hover() -> dict[str, np.ndarray]:
    """The columns, each (2000,), of a drone that hovers: noise alone."""
    count, random = int(SECONDS * RATE), np.random.default_rng(0)

    def noise(size, level=0.0, deviation=0.01):
        return level + deviation * random.normal(size=(count, size))

    vectors = ("position", "world_velocity", "euler", "gyro", "acceleration_bias")
    return paparazzi_columns(
        {"time": np.arange(count) / RATE, "mode": np.ones(count)}
        | {name: noise(3) for name in vectors}
        | {"acceleration": noise(3, np.array([0.0, 0.0, -9.81]))}
        | {"rpm": noise(4, 7497.0, 30.0), "rpm_command": noise(4, 7497.0, 0.0)}
    )


def write_flights(folder, count: int, **options) -> list:
    """Logs ``flight_0.csv`` and so on of ``simulated`` flights."""
    paths = [folder / f"flight_{seed}.csv" for seed in range(count)]
    for seed, path in enumerate(paths):
        write_log(path, simulated(seed, **options))
    return paths
