"""Column names and units of flight logs.

A *quantity* has one to four columns. Motors are in the order front-left, front-right, rear-right,
rear-left, independent of the autopilot's numbering.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig, UnitsConfig

WIDTHS = {
    "time": 1,
    "rpm": 4,
    "rpm_command": 4,
    "rate_command": 3,
    "thrust_command": 1,
    "gyro": 3,
    "acceleration": 3,
    "acceleration_bias": 3,
    "body_velocity": 3,
    "world_velocity": 3,
    "position": 3,
    "euler": 3,
    "quaternion": 4,
    "mode": 1,
}
REQUIRED = ("time", "rpm", "gyro", "acceleration")
# Columns of a format that a log may lack.
OPTIONAL = ("rpm_command", "rate_command", "thrust_command", "position", "euler", "mode")


def _numbered(prefix: str, suffixes: str) -> list[str]:
    return [prefix + suffix for suffix in suffixes]


PRESETS: dict[str, dict[str, list[str]]] = {
    "plain": {
        "time": ["t"],
        "rpm": _numbered("rpm_", "1234"),
        "rpm_command": _numbered("rpm_ref_", "1234"),
        "rate_command": ["p_ref", "q_ref", "r_ref"],
        "thrust_command": ["thrust_ref"],
        "gyro": ["p", "q", "r"],
        "acceleration": ["ax", "ay", "az"],
        "body_velocity": ["vbx", "vby", "vbz"],
        "position": ["x", "y", "z"],
        "euler": ["phi", "theta", "psi"],
    },
    "paparazzi": {
        "time": ["time"],
        "rpm": _numbered("rpm_obs_", "1234"),
        "rpm_command": _numbered("rpm_ref_", "1234"),
        "rate_command": _numbered("rate_ref_", "pqr"),
        "thrust_command": ["thrust_ref"],
        "gyro": _numbered("rate_", "pqr"),
        "acceleration": _numbered("ekf_U", "123"),
        "acceleration_bias": ["ekf_X10", "ekf_X11", "ekf_X12"],
        "world_velocity": _numbered("vel_", "xyz"),
        "position": _numbered("pos_", "xyz"),
        "euler": ["att_phi", "att_theta", "att_psi"],
        "mode": ["autopilot_mode"],
    },
}

# Columns of a written log; the fit does not read the last quantity.
PAPARAZZI = PRESETS["paparazzi"] | {"target_gate": _numbered("target_gate_", "xyz")}

_RADIAN = math.pi / 180.0
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "rpm": {"rpm": 1.0, "krpm": 1e3, "rad/s": 30.0 / math.pi},
    "gyro": {"rad/s": 1.0, "deg/s": _RADIAN},
    "acceleration": {"m/s^2": 1.0, "g": 9.80665},
    "velocity": {"m/s": 1.0, "cm/s": 0.01},
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "angle": {"rad": 1.0, "deg": _RADIAN},
}
UNIT_OF = {
    "time": "time",
    "rpm": "rpm",
    "rpm_command": "rpm",
    "gyro": "gyro",
    "rate_command": "gyro",
    "thrust_command": "acceleration",
    "acceleration": "acceleration",
    "acceleration_bias": "acceleration",
    "body_velocity": "velocity",
    "world_velocity": "velocity",
    "position": "length",
    "euler": "angle",
}


def scale_of(quantity: str, units: "UnitsConfig") -> float:
    """Factor from a quantity's unit to SI or rpm."""
    kind = UNIT_OF.get(quantity)
    return UNITS[kind][getattr(units, kind)] if kind else 1.0


def wanted_columns(config: "LogsConfig", header: list[str]) -> dict[str, list[str]]:
    """Columns of a log to read, by quantity, without those that are optional and absent.

    A quantity with an empty list is not read. ``logs.columns`` for one form of a quantity (world
    velocity, quaternion) replaces the format's other form.
    """
    preset = dict(PRESETS[config.format])
    for given, other in (
        ("world_velocity", "body_velocity"),
        ("body_velocity", "world_velocity"),
        ("quaternion", "euler"),
    ):
        if config.columns.get(given):
            preset.pop(other, None)
    if "acceleration" in config.columns:
        preset.pop("acceleration_bias", None)
    wanted = {}
    for quantity, names in (preset | dict(config.columns)).items():
        absent = all(name not in header for name in names)
        if names and not (absent and quantity in OPTIONAL and quantity not in config.columns):
            wanted[quantity] = list(names)
    return wanted


def paparazzi_columns(quantities: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Quantities, each (n,) or (n, k), as named columns (n,) of a Paparazzi log."""
    return {
        name: column
        for quantity, values in quantities.items()
        for name, column in zip(PAPARAZZI[quantity], np.atleast_2d(values.T), strict=True)
    }
