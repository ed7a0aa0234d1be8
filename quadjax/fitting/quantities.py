"""From the columns of a flight log to quantities: names, units, frames and even times."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import (
    ATTITUDES,
    COMMANDS,
    FROM_FRD,
    QUANTITIES,
    TO_NED,
    UNITS,
    LogFormat,
    Names,
    Quantities,
    Units,
    parse_numbers,
)
from quadjax.fitting.log_table import (
    LogTable,
    continuous,
    indexed_alike,
    interpolated,
    missing,
    unwrapped,
)

BRIDGED_S = 0.02  # of gaps in which a straight line takes the place of the signals
GUARD_S = 0.1  # next to a gap, within the filters' reach
SETTLING_S = 0.5  # until unknown propeller speeds have no effect


def called(function: Callable, path: Path | str, *arguments: object) -> Any:
    """What a user's function returns; its errors as one line."""
    try:
        return function(*arguments)
    except InputError as error:
        line = f"{error}"
        raise InputError(line if line.startswith(f"{path}") else f"{path}: {line}") from error
    except USER_ERRORS as error:
        raise InputError(f"{path}: {user_error(error)}") from error


def wanted_columns(
    path: Path | str, config: LogsConfig, form: LogFormat, header: Sequence[str]
) -> dict[str, list[str]]:
    """Columns of a log to read, by quantity, without those that are optional and absent.

    A quantity with an empty list is not read. ``logs.columns`` for one form of a quantity (world
    velocity, quaternion) replaces the format's other forms.
    """
    preset = dict(form.columns)
    for quantity, others in form.alternatives.items():
        choices = [preset[quantity], *others]
        present = [names for names in choices if set(names) <= set(header)]
        preset[quantity] = (present or choices)[0]
    for forms in (("world_velocity", "body_velocity"), ATTITUDES):
        if any(config.columns.get(name) for name in forms):
            preset = {name: names for name, names in preset.items() if name not in forms}
    if "acceleration" in config.columns:
        preset.pop("acceleration_bias", None)
    wanted = {}
    for quantity, names in (preset | dict(config.columns)).items():
        optional = QUANTITIES[quantity].optional or (
            quantity == "rpm" and "motor_command" in form.columns
        )
        absent = optional and quantity not in config.columns and not set(names) & set(header)
        if names and not absent:
            wanted[quantity] = list(names)
    needed = (
        (("time",), "time (logs.columns.time)"),
        (("gyro",), "gyro (logs.columns.gyro)"),
        (("acceleration",), "acceleration (logs.columns.acceleration)"),
        (("rpm", "motor_command"), "rpm or motor_command (logs.columns)"),
        (("body_velocity", "world_velocity"), "body_velocity or world_velocity (logs.columns)"),
    )
    for quantities, words in needed:
        if not set(quantities) & set(wanted):
            raise InputError(f"{path}: no columns for {words}")
    rotated = "body_velocity" not in wanted and set(wanted["world_velocity"]) <= set(header)
    if rotated and not set(ATTITUDES) & set(wanted):
        raise InputError(
            f"{path}: world_velocity needs columns for {', '.join(ATTITUDES[:-1])} or "
            f"{ATTITUDES[-1]} (logs.columns)"
        )
    return wanted


def convert_quantities(
    table: LogTable, names: Names, units: Units, config: LogsConfig, form: LogFormat
) -> Quantities:
    """Quantities (n,) or (n, k) in SI, rpm, and motor commands from 0 to 1; see ``find_units``.

    Raises:
        InputError: a missing column, columns of different lengths, or a number that is not finite.
    """
    path = table.path
    result: Quantities = {}
    for quantity, group in names.items():
        columns = []
        for name in group:
            if name not in table.columns:
                raise InputError(f"{path}: {missing(name, list(table.columns))}")
            columns.append(values := np.asarray(table.columns[name], np.float64))
            length = len(result.get("time", columns[0]))
            if values.shape != (length,):
                raise InputError(
                    f"{path}: column {name!r} has shape {values.shape}, expected ({length},)"
                )
            for row in np.flatnonzero(~np.isfinite(values))[:1]:
                problem = f" is {values[row]}, expected a finite number"
                raise table.error(row, repr(name), problem)
        if quantity == "time":
            columns = [unwrapped(columns[0])]
        values = np.stack(columns, axis=1) * units[quantity][1]
        if quantity == "motor_command":
            low, high = config.motor_range or _motor_range(path, form, table.settings)
            values = (values - low) / max(high - low, 1e-9)
        result[quantity] = values[:, 0] if len(group) == 1 else values
    return result


def further_motors(names: Names, present: Sequence[str]) -> list[str]:
    """Columns of motors beyond the four of a log."""
    groups = [names.get(quantity, []) for quantity in ("rpm", "rpm_command", "motor_command")]
    found = [name for group in groups for name in indexed_alike(group, present)]
    return [name for name in found if not any(name in group for group in names.values())]


def second_sensors(names: Names, present: Sequence[str]) -> list[str]:
    """Columns like those of a log but for a number that is no index: ``gyro2_x`` and ``gyro_x``."""
    found = []
    for group in names.values():
        indexed = len(group) > 1 and set(group[1:]) == set(indexed_alike(group[:1], group))
        number = r"_?\d+(?=\D.*\d)" if indexed else r"_?\d+"
        plain = {re.sub(number, "", name) for name in group}
        found += [name for name in present if re.sub(number, "", name) in plain]
    return [name for name in found if not any(name in group for group in names.values())]


def check_motors(table: LogTable, names: Names, config: LogsConfig) -> list[str]:
    """The columns of further motors that change, of which the config chose four.

    Raises:
        InputError: a drone of more than four motors.
    """
    further = further_motors(names, list(table.columns))
    values = {name: np.asarray(table.columns[name], np.float64) for name in further}
    beyond = [name for name, x in values.items() if len(np.unique(x[np.isfinite(x)])) > 1]
    not_chosen = {name: group for name, group in names.items() if name not in config.columns}
    if others := further_motors(not_chosen, beyond):
        raise InputError(
            f"{table.path}: columns {', '.join(map(repr, others))} are of more than four motors, "
            "allowed: quadcopters (logs.columns may list the four motors of one)"
        )
    return beyond


def find_units(table: LogTable, names: Names, config: LogsConfig, form: LogFormat) -> Units:
    """The unit of each quantity, and its factor to SI or rpm; "" for a number or none.

    Raises:
        InputError: electrical speeds without the pole pairs of the motors, or pole pairs without
            them.
    """
    units: dict[str, tuple[str, float]] = {}
    for quantity, group in names.items():
        kind = QUANTITIES[quantity].unit
        unit = getattr(config.units, kind) if kind else 1.0
        unit = unit or form.column_units.get(group[0]) or form.units.get(kind)
        unit = unit or QUANTITIES[quantity].si
        units[quantity] = (unit, UNITS[kind][unit]) if isinstance(unit, str) else ("", float(unit))
    electrical = [quantity for quantity, (unit, _) in units.items() if unit.startswith("erpm")]
    for quantity in electrical:
        unit, factor = units[quantity]
        units[quantity] = unit, factor / _pole_pairs(names[quantity], table, config, form)
    if config.pole_pairs is not None and not electrical:
        given, speeds = "the log has no rotor speeds", units.get("rpm", units.get("rpm_command"))
        if speeds:
            given = f"speeds are in {speeds[0] or 'rpm by a factor'} (logs.units.rpm)"
        raise InputError(
            f"{table.path}: logs.pole_pairs is {config.pole_pairs}, which has no effect: {given}, "
            "expected electrical speeds (erpm)"
        )
    return units


def _pole_pairs(
    names: Sequence[str], table: LogTable, config: LogsConfig, form: LogFormat
) -> float:
    """Electrical over propeller speed: of the config, or of the log's head."""
    if config.pole_pairs is not None:
        return float(config.pole_pairs)
    setting = form.poles_setting
    poles = parse_numbers(table.settings, setting) if setting else []
    if len(poles) == 1 and poles[0] >= 2.0:
        return 0.5 * poles[0]
    head = f", nor has the head of the file a setting {setting}" if setting else ""
    raise InputError(
        f"{table.path}: columns {', '.join(map(repr, names))} are electrical speeds, but "
        f"logs.pole_pairs is null{head}; allowed: half the number of magnets of a motor"
    )


def _motor_range(
    path: Path | str, form: LogFormat, settings: Mapping[str, str]
) -> tuple[float, float]:
    """Motor commands that are 0 and 1: of the log's head, or else of the format."""
    if form.motor_setting not in settings:
        return form.motor_range
    span = parse_numbers(settings, form.motor_setting)
    if len(span) != 2 or span[0] >= span[1]:
        raise InputError(
            f"{path}: setting {form.motor_setting} is {settings[form.motor_setting]!r:.80}, "
            "allowed: the lowest and the highest command"
        )
    return span[0], span[1]


def to_standard_frames(
    logged: Quantities, body: str, world: str
) -> tuple[Quantities, tuple[str, str]]:
    """Vectors in body FRD and world NED, with body velocity; the attitude as ``quaternion``.

    Args:
        logged: quantities in the log's frames.
        body: frame of the log, a key of ``FROM_FRD``, or auto.
        world: a key of ``TO_NED``, or auto.

    Returns:
        The quantities, quaternions scalar last, and the two frames.
    """
    rotation = None
    if "quaternion" in logged:
        rotation = Rotation.from_quat(logged["quaternion"][:, [1, 2, 3, 0]])
    elif "rotation" in logged:
        rotation = Rotation.from_matrix(logged["rotation"].reshape(-1, 3, 3))
    elif "euler" in logged:
        rotation = Rotation.from_euler("ZYX", logged["euler"][:, ::-1])
    force = logged["acceleration"] - logged.get("acceleration_bias", 0.0)
    if body == "auto":
        body = "FLU" if np.median(force[:, 2]) > 0.0 else "FRD"
    if world == "auto":
        up = rotation is not None and rotation.apply(force)[:, 2].mean() > 0.0
        world = "ENU" if up else "NED"
    turns = {"body": FROM_FRD[body].inv(), "world": TO_NED[world]}
    result = {
        name: turns[frame].apply(values) if (frame := QUANTITIES[name].frame) else values
        for name, values in logged.items()
    }
    if rotation is not None:
        rotation = TO_NED[world] * rotation * FROM_FRD[body]
        result["quaternion"] = continuous(rotation.as_quat())
        if "body_velocity" not in result:
            result["body_velocity"] = rotation.inv().apply(result["world_velocity"])
    return result, (body, world)


def evenly(quantities: Quantities) -> tuple[Quantities, np.ndarray, np.ndarray]:
    """Quantities at evenly spaced times; commands by their last value.

    Returns:
        The quantities; the samples (n,) bool in flight, without those in and next to a gap, where
        filtered signals are not those of the drone; and the lengths of the gaps, s.
    """
    time, steps = quantities["time"], np.diff(quantities["time"])
    count, usual = len(time), np.median(steps)
    if np.ptp(steps) > 0.01 * usual:
        count = int(round((time[-1] - time[0]) / usual)) + 1
    even = np.linspace(time[0], time[-1], count)
    last = np.searchsorted(time, even + 0.5 * usual, side="right") - 1
    result = {"time": even}
    for name in quantities.keys() - {"time", "mode"}:
        values = quantities[name]
        if name in COMMANDS:
            result[name] = values[last]
        else:
            values = np.unwrap(values, axis=0) if name == "euler" else values
            result[name] = interpolated(even, time, values)
    mode = quantities.get("mode")
    flying = np.ones(count, bool) if mode is None else mode[last] > 0
    after = SETTLING_S if "rpm" not in quantities else GUARD_S
    gaps = np.flatnonzero(steps > max(BRIDGED_S, 2.5 * usual))
    for gap in gaps:
        flying &= (even < time[gap] - GUARD_S) | (even > time[gap + 1] + after)
    return result, flying, steps[gaps]
