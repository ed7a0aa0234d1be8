"""Formats of flight logs: quantities, and the names, units and frames of their columns.

A *quantity* has one to nine columns. Motors are in the order front-left, front-right, rear-right,
rear-left, independent of the autopilot's numbering. A format is a ``LogFormat``: one of ``FORMATS``
or a user's own object (``"module:OBJECT"``).
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.imports import load_object
from quadjax.fitting import ulog
from quadjax.fitting.log_table import LogTable
from quadjax.vehicle.airframe import RPM_PER_RAD_S

Quantities = dict[str, np.ndarray]
Names = Mapping[str, list[str]]  # of columns, by quantity
Units = Mapping[str, tuple[str, float]]  # names, "" for a number, and factors, by quantity
FLIP = np.array([1.0, -1.0, -1.0])  # FLU <-> FRD
ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
TO_NED = {"NED": Rotation.identity(), "ENU": ENU}  # from the world frame of a log
FROM_FRD = {"FRD": Rotation.identity(), "FLU": Rotation.from_quat([1.0, 0.0, 0.0, 0.0])}


@dataclass(frozen=True)
class Quantity:
    """What some columns of a log measure, in SI, rpm, and motor commands from 0 to 1."""

    width: int  # number of columns
    unit: str = ""  # kind of unit, a key of ``UNITS``; "" for none
    frame: str = ""  # "body" or "world" for a vector's axes
    optional: bool = False  # whether a log may lack the columns of its format
    may_be_constant: bool = False  # whether it may be constant throughout a flight
    # lowest and highest value, of all columns or of each; none for any
    range: tuple[float | tuple[float, ...], float | tuple[float, ...]] | tuple[()] = ()

    @property
    def si(self) -> str:
        """The unit of the values in the package."""
        return next(iter(UNITS[self.unit])) if self.unit else ""


QUANTITIES = {
    "time": Quantity(1, "time", may_be_constant=True),
    "rpm": Quantity(4, "rpm", range=(-100.0, 1e5)),
    "rpm_command": Quantity(4, "rpm", "", True, True, (-100.0, 1e5)),
    "motor_command": Quantity(4, "", "", True, True, (-0.02, 1.02)),
    "rate_command": Quantity(3, "gyro", "body", True, True, (-60.0, 60.0)),
    "thrust_command": Quantity(1, "acceleration", "", True, True, (-400.0, 400.0)),
    "gyro": Quantity(3, "gyro", "body", range=(-60.0, 60.0)),
    "acceleration": Quantity(3, "acceleration", "body", range=(-400.0, 400.0)),
    "acceleration_bias": Quantity(3, "acceleration", "body", False, True, (-10.0, 10.0)),
    "body_velocity": Quantity(3, "velocity", "body", range=(-100.0, 100.0)),
    "world_velocity": Quantity(3, "velocity", "world", range=(-100.0, 100.0)),
    "position": Quantity(3, "length", "world", optional=True),
    "euler": Quantity(3, "angle", "", True, False, ((-3.2, -1.6, -1e3), (3.2, 1.6, 1e3))),
    "quaternion": Quantity(4, optional=True),
    "rotation": Quantity(9, optional=True, may_be_constant=True),
    "mode": Quantity(1, optional=True, may_be_constant=True),
}
ATTITUDES = ("euler", "quaternion", "rotation")
COMMANDS = ("rpm_command", "motor_command", "rate_command", "thrust_command")
UNITS: dict[str, dict[str, float]] = {  # factors to the first unit of each kind
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    # electrical speeds: of one pair of poles
    "rpm": {
        "rpm": 1.0,
        "krpm": 1e3,
        "rad/s": RPM_PER_RAD_S,
        "Hz": 60.0,
        "erpm": 1.0,
        "erpm/100": 100.0,
    },
    "gyro": {"rad/s": 1.0, "deg/s": math.pi / 180.0},
    "acceleration": {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3},
    "velocity": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001},
    "length": {"m": 1.0, "cm": 0.01, "mm": 0.001},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0},
}


@dataclass(frozen=True)
class LogFormat:
    """A format of flight logs.

    Attributes:
        columns: names of the columns by quantity (see ``quadjax.fitting.formats.QUANTITIES``);
            motors in the order front-left, front-right, rear-right, rear-left.
        alternatives: further names by quantity, used where a log lacks the first ones.
        units: by kind, where they are not SI and rpm (see ``quadjax.fitting.formats.UNITS``).
        column_units: of further names, by the first one of a quantity, where they are others.
        body_frame: FRD, FLU, or auto: by the direction of the thrust.
        world_frame: NED, ENU, or auto: by the direction of gravity.
        motor_range: values of a motor command that are 0 and 1.
        motor_setting: the setting with both in the log's head, if it has one.
        poles_setting: the setting with the number of poles of a motor, if it has one.
        settings: rows of a setting and its value precede a CSV file's header.
        adjust: ``(quantities, settings) -> quantities``, called with quantities of ``columns`` by
            name, each (n, k) in SI or rpm, in the log's frames.
        read: ``(path) -> columns``, each (n,) by name, or a ``LogTable`` of them, for files that
            are no CSV tables; None reads a CSV file.
    """

    columns: Mapping[str, list[str]]
    alternatives: Mapping[str, tuple[list[str], ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    column_units: Mapping[str, str] = field(default_factory=dict)
    body_frame: str = "FRD"
    world_frame: str = "NED"
    motor_range: tuple[float, float] = (0.0, 1.0)
    motor_setting: str = ""
    poles_setting: str = ""
    settings: bool = False
    adjust: Callable[[Quantities, Mapping[str, str]], Quantities] | None = None
    read: Callable[[Path], Mapping[str, np.ndarray] | LogTable] | None = None


def names(pattern: str, suffixes: str = "xyz") -> list[str]:
    """Names of columns: a pattern with each of some suffixes in place of ``*``."""
    return [pattern.replace("*", suffix) for suffix in suffixes]


def parse_numbers(settings: Mapping[str, str], name: str) -> list[float]:
    """The numbers in the value of a setting; none without it."""
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?", settings.get(name, ""))]


def blackbox_setting(settings: Mapping[str, str], name: str) -> float:
    """The number of a setting of a blackbox; 0 without it.

    Raises:
        InputError: a value that is not a number from 0 on.
    """
    numbers = parse_numbers(settings, name) if name in settings else [0.0]
    if len(numbers) != 1 or numbers[0] < 0.0:
        raise InputError(f"setting {name} is {settings[name]!r:.80}, allowed: a number from 0 on")
    return numbers[0]


def adjust_blackbox(quantities: Quantities, settings: Mapping[str, str]) -> Quantities:
    """Scale the sensors' counts by the log's settings; sensors in FRD axes.

    Rows of a setting and its value may precede the header. The reader uses ``acc_1G`` (required if
    the accelerometer is in counts), ``motorOutput`` (values of motor commands 0 and 1; 158 and 2048
    without it), ``blackbox_high_resolution`` (the gyro is ten times larger) and ``motor_poles`` (of
    electrical speeds; ``logs.pole_pairs`` overrides it). Accelerometer and
    gyro are in FLU axes in some versions of the firmware and in FRD axes in others: where the
    specific force points along positive z, y and z are negated. In all versions the attitude is
    that of FRD axes in NED. Logs without a position estimate lack the velocity and are rejected:
    add the columns of a motion capture system.
    """
    gyro, force = quantities["gyro"], quantities["acceleration"]
    if np.median(np.linalg.norm(force, axis=1)) > 200.0:  # m/s^2: counts
        one_g = blackbox_setting(settings, "acc_1G")
        if not one_g:
            raise InputError(
                "the accelerometer is in counts, but the head of the file has no setting acc_1G, "
                "the counts of 1 g (512, 2048 or 4096): add a row before the header: acc_1G,2048"
            )
        force = force / one_g
    if blackbox_setting(settings, "blackbox_high_resolution"):
        gyro = gyro / 10.0
    flip = FLIP if np.median(force[:, 2]) > 0.0 else 1.0
    return quantities | {"gyro": gyro * flip, "acceleration": force * flip}


def adjust_tii(quantities: Quantities, _settings: Mapping[str, str]) -> Quantities:
    """The rotation matrix's elements in the order of its rows.

    In the files they are in the order of rows or of columns: the one whose change is the gyro's.
    Body FLU or FRD and world z up or z down are found from the specific force. There are no rotor
    speeds: the motors are fitted by their effect on thrust and moments, up to a common scale.
    ``w_max`` is that of the base vehicle, or of ``body.rpm_range``; all other constants are right
    relative to it.
    """
    elements, span = quantities.get("rotation"), 10  # samples that the change is taken over
    if elements is None or len(elements) <= 2 * span:
        return quantities
    seconds = quantities["time"][2 * span :] - quantities["time"][: -2 * span]
    measured = quantities["gyro"][span:-span] * seconds[:, None]
    matrices, errors = elements.reshape(-1, 3, 3), []
    for matrix in (matrices, matrices.swapaxes(1, 2)):
        attitude = Rotation.from_matrix(matrix)
        turn = (attitude[: -2 * span].inv() * attitude[2 * span :]).as_rotvec()
        errors.append(((turn - measured) ** 2).mean())
    if errors[1] < errors[0]:
        elements = matrices.swapaxes(1, 2).reshape(-1, 9)
    return quantities | {"rotation": elements}


PLAIN = {
    "time": ["t"],
    "rpm": names("rpm_*", "1234"),
    "rpm_command": names("rpm_ref_*", "1234"),
    "rate_command": names("*_ref", "pqr"),
    "thrust_command": ["thrust_ref"],
    "gyro": names("*", "pqr"),
    "acceleration": names("a*"),
    "body_velocity": names("vb*"),
    "position": names("*"),
    "euler": ["phi", "theta", "psi"],
}
PAPARAZZI = {
    "time": ["time"],
    "rpm": names("rpm_obs_*", "1234"),
    "rpm_command": names("rpm_ref_*", "1234"),
    "rate_command": names("rate_ref_*", "pqr"),
    "thrust_command": ["thrust_ref"],
    "gyro": names("rate_*", "pqr"),
    "acceleration": names("ekf_U*", "123"),
    "acceleration_bias": names("ekf_X1*", "012"),
    "world_velocity": names("vel_*"),
    "position": names("pos_*"),
    "euler": ["att_phi", "att_theta", "att_psi"],
    "mode": ["autopilot_mode"],
}
# Columns of written logs. A fit reads motor_command only by ``logs.columns``, and no target_gate.
WRITTEN_PLAIN = PLAIN | {"motor_command": names("motor_*", "1234")}
WRITTEN = PAPARAZZI | {"target_gate": names("target_gate_*")}
FORMATS: dict[str, LogFormat] = {
    "plain": LogFormat(PLAIN),
    "paparazzi": LogFormat(PAPARAZZI),
    "blackbox": LogFormat(  # of Betaflight and INDIflight as CSV
        {
            "time": ["time"],
            "rpm": names("omega[*]", "3102"),
            "motor_command": names("motor[*]", "3102"),
            "gyro": names("gyroADC[*]", "012"),
            "acceleration": names("accSmooth[*]", "012"),
            "world_velocity": names("vel[*]", "012"),
            "position": names("pos[*]", "012"),
            "quaternion": names("quat[*]", "0123"),
        },
        {
            "time": (["time (us)"],),
            "rpm": (names("omegaUnfiltered[*]", "3102"), names("eRPM[*]", "3102")),
            "world_velocity": (names("extVel[*]", "012"),),
            "position": (names("extPos[*]", "012"),),
        },
        {
            "time": "us",
            "rpm": "rad/s",
            "gyro": "deg/s",
            "acceleration": "g",
            "velocity": "cm/s",
            "length": "mm",
        },
        {"eRPM[3]": "erpm/100"},
        motor_range=(158.0, 2048.0),  # DSHOT
        motor_setting="motorOutput",
        poles_setting="motor_poles",
        settings=True,
        adjust=adjust_blackbox,
    ),
    "tii": LogFormat(  # of the TII-RATM drone racing dataset, version 3: no rotor speeds
        {
            "time": ["elapsed_time"],
            "motor_command": names("thrust[*]", "3102"),
            "gyro": names("gyro_*"),
            "acceleration": names("accel_*"),
            "world_velocity": names("drone_velocity_linear_*"),
            "position": names("drone_*"),
            "rotation": names("drone_rot[*]", "012345678"),
        },
        body_frame="auto",
        world_frame="auto",
        adjust=adjust_tii,
    ),
    "ulog": LogFormat(ulog.COLUMNS, units={"time": "us"}, read=ulog.read_ulog),
}
ALLOWED = f"{', '.join(FORMATS)} or 'module:OBJECT'"


def log_format(reference: str) -> LogFormat:
    """A format by name, or a user's own (``"module:OBJECT"``).

    Raises:
        InputError: an object that cannot be imported, or is no format.
    """
    if reference in FORMATS:
        return FORMATS[reference]
    form = load_object(reference, "logs.format")
    if not isinstance(form, LogFormat):
        raise InputError(f"logs.format is {reference!r}: not a LogFormat; allowed: {ALLOWED}")
    return form


def paparazzi_columns(quantities: Quantities) -> Quantities:
    """Quantities, each (n,) or (n, k), as named columns (n,) of a Paparazzi log."""
    return named_columns(quantities, WRITTEN)


def named_columns(quantities: Quantities, columns: Mapping[str, list[str]]) -> Quantities:
    """Quantities, each (n,) or (n, k), as columns (n,) of the names of a format."""
    return {
        name: column
        for quantity, values in quantities.items()
        for name, column in zip(columns[quantity], np.atleast_2d(values.T), strict=True)
    }
