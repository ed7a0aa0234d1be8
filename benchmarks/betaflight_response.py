"""How Betaflight follows steps of its sticks in hover, with default and with tuned gains.

A row of ``benchmarks/results/betaflight_response.json`` has a drone and its gains. Tuned are those
of a grid of factors on all P and on all D with the smallest error: of roll, pitch and yaw, the mean
of the rms difference of rate and command.

    python -m benchmarks.betaflight_response
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks import rows
from benchmarks.betaflight_contenders import DRONES, INDI
from benchmarks.betaflight_steps import SIZES, lag, running, stepped, wanted
from quadjax.cli import script
from quadjax.sil.betaflight import lines

FILE = "betaflight_response"
GAINS = {"p_roll": 45, "p_pitch": 47, "p_yaw": 45, "d_roll": 30, "d_pitch": 34}
GAINS |= {"d_max_roll": 40, "d_max_pitch": 46}  # Betaflight's defaults
FACTORS = {"p": (0.7, 1.0, 1.4, 2.0), "d": (0.5, 0.7, 1.0, 1.4, 2.0)}


def gains(p: float, d: float) -> list[str]:
    """Settings of factors on the default gains."""
    factor = {"p": p, "d": d}
    return [f"{name}={round(factor[name[0]] * gain)}" for name, gain in GAINS.items()]


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
