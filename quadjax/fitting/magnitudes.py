"""Checks of a flight log's time and units by the magnitudes of single columns.

Each check raises an ``InputError`` of one line with the file, the column and the row.
"""

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import QUANTITIES, UNITS, Names, Quantities, Units
from quadjax.fitting.log_table import LogTable, time_fault

LEAST_ROWS = 50  # of a log, for the filters
DETERMINANT_SLACK = 0.1  # of a rotation matrix, from 1
SLOWEST_RPM, FASTEST_RPM = 2000.0, 60_000.0  # medians of propeller speeds in flight
MAX_SCALE_RATIO = 1.25  # largest factor on a scale that another unit explains
USUAL_PAIRS = 7  # of poles, of most motors of racing quadcopters


def flying(quantities: Quantities) -> np.ndarray:
    """Rows in flight: by the log's mode, or else by propeller speed."""
    mode = quantities.get("mode")
    if mode is not None and (mode > 0).any():
        return mode > 0
    speeds = quantities["rpm" if "rpm" in quantities else "motor_command"]
    mean = np.abs(speeds).mean(axis=1)
    return mean >= 0.5 * np.median(mean)


def check_time(log: LogTable, names: Names, quantities: Quantities, config: LogsConfig) -> None:
    """Time must increase without gaps, for long enough, at a plausible rate."""
    time, column = quantities["time"], f"{names['time'][0]!r}: "
    last = len(time) - 1
    if len(time) < LEAST_ROWS:
        problem = f"the file ends after {len(time)} rows of data, expected at least {LEAST_ROWS}"
        raise log.error(last, column, problem)
    usual, seconds = float(np.median(np.diff(time))), time[-1] - time[0]
    if fault := time_fault(time, np.inf):
        raise log.error(fault[0], column, fault[1])
    if not 2e-4 < usual < 0.051:
        problem = f"samples are {usual:.3g} s apart, expected 0.0002 to 0.05 s; is "
        raise log.error(1, column, problem + "logs.units.time right?")
    if fault := time_fault(time, max(config.max_gap, 2.5 * usual)):
        cause = log.causes.get(fault[0], "")
        raise log.error(fault[0], column, f"{fault[1]}{cause} (logs.max_gap)")
    if seconds < config.min_seconds:
        problem = f"the file ends after {seconds:.3g} s, expected at least {config.min_seconds:g} s"
        raise log.error(last, column, problem)


def check_attitude(log: LogTable, names: Names, quantities: Quantities) -> None:
    """Rotation matrices must have the determinant 1, quaternions a length above 0."""
    for form, word in (("rotation", "determinant"), ("quaternion", "length")):
        if form not in quantities:
            continue
        values = quantities[form]
        if form == "rotation":
            size = np.linalg.det(values.reshape(-1, 3, 3))
            bad = np.abs(size - 1.0) > DETERMINANT_SLACK
        else:
            size = np.linalg.norm(values, axis=1)
            bad = size == 0.0
        for row in np.flatnonzero(bad)[:1]:
            problem = f"an attitude with a {word} of {size[row]:.3g}, expected 1"
            raise log.error(row, f"{names[form][0]!r} and on: ", problem)


def check_columns(
    log: LogTable, names: Names, quantities: Quantities, units: Units, config: LogsConfig
) -> None:
    """Measurements must not be constant in flight, nor beyond their range in ``QUANTITIES``.

    The motors turn at about the same speed, and at that of their commands. ``units`` are those of
    the columns, with their factors.
    """
    airborne = flying(quantities)
    for quantity, values in quantities.items():
        row, unit = QUANTITIES[quantity], units[quantity]
        for i, (name, column) in enumerate(
            zip(names[quantity], np.atleast_2d(values.T), strict=True)
        ):
            if not row.may_be_constant and np.ptp(column[airborne]) == 0.0:
                raise InputError(
                    f"{log.path}: column {name!r} is {column[airborne][0]:.6g} throughout the "
                    f"flight, expected a measurement of {quantity}"
                )
            if quantity in ("rpm", "rpm_command"):
                _check_median(log, name, column, airborne, unit)
            if not row.range:
                continue
            low, high = (np.broadcast_to(bound, row.width)[i] for bound in row.range)
            beyond = (column < low) | (column > high)
            if quantity == "motor_command":
                beyond &= airborne
            for sample in np.flatnonzero(beyond)[:1]:
                problem = f" is {column[sample]:.4g} {row.si}, expected {low:g} to {high:g}"
                hint = unit_hint(row.unit, np.abs(column).max(), unit, 0.0, high)
                raise log.error(sample, repr(name), problem + hint)
    _check_levels(log, names, quantities, 1.0 + config.max_scale_error)


def _check_median(
    log: LogTable, name: str, speeds: np.ndarray, airborne: np.ndarray, unit: tuple[str, float]
) -> None:
    """The median speed in flight must be that of a propeller; ``unit`` and its factor to rpm."""
    rows = np.flatnonzero(airborne)
    middle = float(np.median(speeds[rows]))
    if SLOWEST_RPM <= middle <= FASTEST_RPM:
        return
    hint = unit_hint("rpm", middle, unit, SLOWEST_RPM, FASTEST_RPM)
    expected = f"expected {SLOWEST_RPM:g} to {FASTEST_RPM:g}{hint}"
    if middle < -SLOWEST_RPM:
        expected = "expected no sign"
    problem = f"a median of {middle:.4g} rpm in flight; {expected}"
    raise log.error(rows[0], f"{name!r} and on: ", problem)


def unit_hint(kind: str, value: float, unit: tuple[str, float], low: float, high: float) -> str:
    """The key that would bring a value of a kind of unit between low and high, as a question.

    ``unit`` is the present one and its factor, which for electrical speeds has the pole pairs.
    """
    if not kind:
        return "; is logs.motor_range right?"
    likely, number = [], abs(value) / unit[1]
    for name, factor in UNITS[kind].items():
        electrical = name.startswith("erpm")
        size = number * factor / (USUAL_PAIRS if electrical else 1)
        if name != unit[0] and low <= size <= high:
            likely.append(name + " (with logs.pole_pairs)" * electrical)
    if kind == "rpm":
        likely.append("the rpm of 1")
    if unit[0].startswith("erpm"):
        electrical_speed = number * UNITS[kind][unit[0]]
        pairs = round(electrical_speed / (low * high) ** 0.5)
        if pairs and low <= electrical_speed / pairs <= high:
            likely.append(f"logs.pole_pairs {pairs}")
    return f"; is logs.units.{kind} {' or '.join(likely)}?" if likely else ""


def scale_hint(kind: str, scale: float, unit: tuple[str, float]) -> str:
    """The key that explains values of which ``scale`` times are right; see ``unit_hint``."""
    return unit_hint(kind, 1.0, unit, scale / MAX_SCALE_RATIO, scale * MAX_SCALE_RATIO)


def _check_levels(log: LogTable, names: Names, quantities: Quantities, largest: float) -> None:
    rows = flying(quantities)
    if "rpm" not in quantities:
        return
    medians = np.median(quantities["rpm"][rows], axis=0)
    for i, name in enumerate(names["rpm"]):
        factor = medians[i] / np.delete(medians, i).mean()
        if not 1.0 / largest <= factor <= largest:
            raise InputError(
                f"{log.path}: column {name!r} is {factor:.3g} times the other motors' speeds "
                f"(median {medians[i]:.4g} rpm); allowed: logs.max_scale_error"
            )
    if "rpm_command" in quantities:
        factor = float(np.median(np.median(quantities["rpm_command"][rows], axis=0) / medians))
        if not 1.0 / largest <= factor <= largest:
            commands, speeds = (", ".join(map(repr, names[q])) for q in ("rpm_command", "rpm"))
            raise InputError(
                f"{log.path}: columns {commands} are {factor:.3g} times the speeds {speeds} "
                "(logs.units.rpm, logs.max_scale_error)"
            )
