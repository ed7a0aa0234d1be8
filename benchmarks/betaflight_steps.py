"""Steps of the sticks of Betaflight's firmware, with the drone of a vehicle file in hover."""

import contextlib
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.sil.betaflight import RESTING, Sticks, arm, exchange
from quadjax.sil.betaflight_firmware import STEP, Firmware, find_firmware
from quadjax.vehicle import racing
from quadjax.vehicle.protocol import RigidBodyState, VehicleParams
from quadjax.vehicle.vehicle_file import read_vehicle

HIGHEST = np.array([8.0, 8.0, 4.0])  # rad/s, of the sticks
SIZES = {"roll": 3.0, "pitch": 3.0, "yaw": 3.0, "thrust": 3.0}  # of a step, rad/s and m/s^2
REST, LASTS = 300, 200  # ms before the steps, and of each: plus, minus, plus
HOVER = np.array([0.0, 0.0, 0.0, 9.81], np.float32)


@functools.lru_cache
def constants_of(drone: str) -> racing.RacingConstants:
    """The constants of a vehicle file."""
    return jax.tree.map(jnp.float32, read_vehicle(drone).racing)


@contextlib.contextmanager
def running(drone: str, *settings: str) -> Iterator[tuple[Firmware, Sticks]]:
    """The firmware of a drone, with lines of settings."""
    constants = constants_of(drone)
    sticks = Sticks(constants, HIGHEST)
    with Firmware(
        find_firmware(), [*sticks.settings(float(constants.turning.w1)), *settings]
    ) as firmware:
        yield firmware, sticks


@jax.jit
def after_step(
    constants: racing.RacingConstants, body: RigidBodyState, command: jax.Array
) -> tuple[RigidBodyState, list[jax.Array]]:
    """The body one ``STEP`` later, and its rates, specific force and attitude."""
    params, model = VehicleParams(constants), racing.MODEL
    change = model.derivative(params, body, Rotors(*command))
    body = jax.tree.map(lambda x, rate: x + STEP * rate, body, change).wrapped()
    parts = body.rates, model.specific_force(params, body), body.attitude
    return body, [jnp.stack(jax.tree.leaves(part)) for part in parts]


def wanted(axis: str, lasts: int = LASTS) -> np.ndarray:
    """The steps (3 lasts,) that are commanded: plus, minus, plus."""
    return SIZES[axis] * np.repeat([1.0, -1.0, 1.0], lasts)


def stepped(
    firmware: Firmware, sticks: Sticks, drone: str, axis: str, lasts: int = LASTS, rest: int = REST
) -> np.ndarray:
    """Rates and thrust (3 lasts, 4) of a drone in hover whose sticks step about an axis."""
    constants, zero, index = constants_of(drone), jnp.float32(0), list(SIZES).index(axis)
    none, hover = Vec3(zero, zero, zero), racing.MODEL.hover_actuators(constants)
    level = Quaternion(jnp.float32(1), zero, zero, zero)
    body = RigidBodyState(none, none, level, none, hover, None, None)
    now, found = RESTING.copy(), []
    after_step(constants, body, np.zeros(4, np.float32))
    arm(firmware)
    for step in np.concatenate([np.zeros(rest), wanted(axis, lasts)]):
        command = HOVER.copy()
        command[index] += step
        motors = exchange(firmware, now, sticks.of(command))
        body, numbers = after_step(constants, body, motors)
        for name, value in zip(("rates", "specific_force", "quaternion"), numbers, strict=True):
            now[name] = value
        found.append([*now["rates"], -now["specific_force"][2] - HOVER[3]])
    return np.array(found)[rest:]


def lag(command: np.ndarray, found: np.ndarray) -> tuple[float, float, float]:
    """Rms error, lag, s, and dead time, s, of the best first-order response to a command."""

    def error(tau: float, dead: int) -> float:
        late, value, total = np.concatenate([np.zeros(dead), command]), 0.0, 0.0
        for goal, now in zip(late, found, strict=False):
            value += (goal - value) * STEP / tau
            total += (now - value) ** 2
        return (total / len(found)) ** 0.5

    taus = np.arange(0.006, 0.06, 0.002)
    return min((error(tau, dead), tau, dead * STEP) for tau in taus for dead in range(0, 24, 2))
