"""Column names and units of flight logs.

A *quantity* has one to four columns. Motors are in the order front-left, front-right, rear-right,
rear-left, independent of the autopilot's numbering.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig, UnitsConfig

WIDTHS = {
    "time": 1,
    "rpm": 4,
    "rpm_command": 4,
    "motor_command": 4,
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
    "rotation": 9,
    "mode": 1,
}
REQUIRED = ("time", "gyro", "acceleration")
ATTITUDES = ("euler", "quaternion", "rotation")
# Columns of a format that a log may lack.
OPTIONAL = (
    *("rpm_command", "motor_command", "rate_command", "thrust_command"),
    *("position", "mode", *ATTITUDES),
)


def _numbered(prefix: str, suffixes: str) -> list[str]:
    return [prefix + suffix for suffix in suffixes]


PLAIN = {
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
}
PAPARAZZI = {
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
}
# Columns of a written log; the fit does not read the last quantity.
WRITTEN = PAPARAZZI | {"target_gate": _numbered("target_gate_", "xyz")}

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
SI = {kind: next(iter(units)) for kind, units in UNITS.items()}
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
    return UNITS[kind][getattr(units, kind) or SI[kind]] if kind else 1.0


def wanted_columns(
    config: "LogsConfig",
    header: list[str],
    columns: Mapping[str, list[str]],
    alternatives: Mapping[str, tuple[list[str], ...]],
) -> dict[str, list[str]]:
    """Columns of a log to read, by quantity, without those that are optional and absent.

    A quantity with an empty list is not read. ``logs.columns`` for one form of a quantity (world
    velocity, quaternion) replaces the format's other forms.

    Args:
        config: with the user's own names.
        header: names of all columns.
        columns: the format's.
        alternatives: names in place of them where a log lacks the first ones.
    """
    preset = dict(columns)
    for quantity, others in alternatives.items():
        for names in [preset[quantity], *others]:
            if set(names) <= set(header):
                preset[quantity] = names
                break
    for forms in (("world_velocity", "body_velocity"), ATTITUDES):
        if given := [form for form in forms if config.columns.get(form)]:
            preset = {
                name: own for name, own in preset.items() if name in given or name not in forms
            }
    if "acceleration" in config.columns:
        preset.pop("acceleration_bias", None)
    optional = OPTIONAL if "motor_command" not in columns else (*OPTIONAL, "rpm")
    wanted = {}
    for quantity, names in (preset | dict(config.columns)).items():
        absent = all(name not in header for name in names)
        if names and not (absent and quantity in optional and quantity not in config.columns):
            wanted[quantity] = list(names)
    return wanted


def paparazzi_columns(quantities: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Quantities, each (n,) or (n, k), as named columns (n,) of a Paparazzi log."""
    return {
        name: column
        for quantity, values in quantities.items()
        for name, column in zip(WRITTEN[quantity], np.atleast_2d(values.T), strict=True)
    }
