"""Blackbox logs of Betaflight and INDIflight as CSV, with the settings of the log's head.

Accelerometer and gyro are in FLU axes in some versions of the firmware and in FRD axes in others:
the direction of the thrust tells. The attitude is that of FRD axes in NED in all of them.
"""

from collections.abc import Mapping

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.csv_table import numbers_of

Quantities = dict[str, np.ndarray]
ORDER = (3, 1, 0, 2)  # motors front-left, front-right, rear-right, rear-left


def _motors(name: str) -> list[str]:
    return [f"{name}[{index}]" for index in ORDER]


def _axes(name: str, count: int = 3) -> list[str]:
    return [f"{name}[{index}]" for index in range(count)]


COLUMNS = {
    "time": ["time"],
    "rpm": _motors("omega"),
    "motor_command": _motors("motor"),
    "gyro": _axes("gyroADC"),
    "acceleration": _axes("accSmooth"),
    "world_velocity": _axes("vel"),
    "position": _axes("pos"),
    "quaternion": _axes("quat", 4),
}
ALTERNATIVES = {
    "time": (["time (us)"],),
    "rpm": (_motors("omegaUnfiltered"),),
    "world_velocity": (_axes("extVel"),),
    "position": (_axes("extPos"),),
}
UNITS = {
    "time": "us",
    "rpm": "rad/s",
    "gyro": "deg/s",
    "acceleration": "g",
    "velocity": "cm/s",
    "length": "mm",
}
MOTOR_RANGE = (158.0, 2048.0)  # DSHOT
HIGH_RESOLUTION = 10.0  # factor of the gyro's columns
COUNTS = 200.0  # m/s^2, of a median specific force that is in counts
FLIP = np.array([1.0, -1.0, -1.0])


def setting(settings: Mapping[str, str], name: str, default: float) -> float:
    """The number of a setting; a default without it, or where it is 0.

    Raises:
        InputError: a value that is not a number from 0 on.
    """
    if name not in settings:
        return default
    found = numbers_of(settings, name)
    if len(found) != 1 or found[0] < 0.0:
        raise InputError(f"setting {name} is {settings[name]!r:.80}, allowed: a number from 0 on")
    return found[0] or default


def adjust(quantities: Quantities, settings: Mapping[str, str]) -> Quantities:
    """Scale the sensors' counts by the log's settings; sensors in FRD axes."""
    result = dict(quantities)
    force = result["acceleration"]
    if np.median(np.linalg.norm(force, axis=1)) > COUNTS:
        one_g = setting(settings, "acc_1G", 0.0)
        if not one_g:
            raise InputError(
                "the accelerometer is in counts, but the head of the file has no setting acc_1G, "
                "the counts of 1 g (512, 2048 or 4096): add a row before the header: acc_1G,2048"
            )
        force = force / one_g
    if setting(settings, "blackbox_high_resolution", 0.0):
        result["gyro"] = result["gyro"] / HIGH_RESOLUTION
    flip = FLIP if np.median(force[:, 2]) > 0.0 else 1.0
    return result | {"gyro": result["gyro"] * flip, "acceleration": force * flip}
