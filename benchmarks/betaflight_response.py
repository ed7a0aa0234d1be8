"""How Betaflight follows steps of its sticks in hover, with default and with tuned gains.

A row of ``benchmarks/results/betaflight_response.json`` has a drone and its gains. Tuned are those
of a grid of factors on all P and on all D with the smallest error: of roll, pitch and yaw, the mean
of the rms difference of rate and command.

    python -m benchmarks.betaflight_response
"""

import contextlib
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import rows
from benchmarks.betaflight_contenders import DRONES, INDI
from quadjax.cli import script
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.sil.betaflight import RESTING, Sticks, arm, exchange
from quadjax.sil.betaflight_firmware import STEP, Firmware, find_firmware
from quadjax.vehicle import racing
from quadjax.vehicle.protocol import RigidBodyState, VehicleParams
from quadjax.vehicle.vehicle_file import read_vehicle

FILE = "betaflight_response"
HIGHEST = np.array([8.0, 8.0, 4.0])  # rad/s, of the sticks
SIZES = {"roll": 3.0, "pitch": 3.0, "yaw": 3.0, "thrust": 3.0}  # of a step, rad/s and m/s^2
REST, LASTS = 300, 200  # ms before the steps, and of each: plus, minus, plus
HOVER = np.array([0.0, 0.0, 0.0, 9.81], np.float32)
GAINS = {"p_roll": 45, "p_pitch": 47, "p_yaw": 45, "d_roll": 30, "d_pitch": 34}
GAINS |= {"d_max_roll": 40, "d_max_pitch": 46}  # Betaflight's defaults
FACTORS = {"p": (0.7, 1.0, 1.4, 2.0), "d": (0.5, 0.7, 1.0, 1.4, 2.0)}


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


def gains(p: float, d: float) -> list[str]:
    """Settings of factors on the default gains."""
    factor = {"p": p, "d": d}
    return [f"{name}={round(factor[name[0]] * gain)}" for name, gain in GAINS.items()]


def lines(settings: Sequence[str]) -> list[str]:
    """Settings as lines of the command line."""
    return [f"set {setting.replace('=', ' = ')}" for setting in settings]


def measure(drone: str, settings: Sequence[str], axes: Sequence[str]) -> dict[str, Any]:
    """Error, dead time and lag of each axis."""
    made: dict[str, Any] = {}
    with running(drone, *lines(settings)) as (firmware, sticks):
        for index, axis in enumerate(axes):
            found = stepped(firmware, sticks, drone, axis)[:, index]
            error = float(np.sqrt(((found - wanted(axis)) ** 2).mean()))
            rest, tau, dead = lag(wanted(axis), found) if len(axes) == len(SIZES) else (0, 0, 0)
            made[axis] = {"error": round(error, 3), "fit error": round(float(rest), 3)}
            made[axis] |= {"dead time": round(dead, 3), "lag": round(float(tau), 3)}
    made["error"] = round(float(np.mean([made[axis]["error"] for axis in list(SIZES)[:3]])), 3)
    return made


def betaflight_response(*, drones: tuple[str, ...] = DRONES) -> None:
    """Measure the response of drones with default and tuned gains, and write the rows."""
    for drone in drones:
        grid = {}
        for p, d in itertools.product(*FACTORS.values()):
            grid[p, d] = measure(drone, gains(p, d), list(SIZES)[:3])["error"]
            print(drone, p, d, grid[p, d], flush=True)
        p, d = min(grid, key=lambda pair: grid[pair])
        for name, settings in (("default", []), ("tuned", gains(p, d))):
            row = {
                "name": f"{drone}, {name}",
                "command": f"python -m benchmarks.betaflight_response --drones {drone}",
                "config": [INDI[0], f"vehicle={drone}_betaflight"],
                "seeds": [0],
                "drone": drone,
                "gains": name if name == "default" else f"P x {p:g}, D x {d:g}",
                "settings": settings,
            }
            rows.write(FILE, [row | measure(drone, settings, list(SIZES))])


if __name__ == "__main__":
    script(betaflight_response)
