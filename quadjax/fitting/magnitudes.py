"""Checks of a flight log's time, units and directions by the magnitudes of single columns.

Each check raises an ``InputError`` of one line with the file, the column and the row.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import QUANTITIES, Quantities
from quadjax.fitting.log_table import time_fault
from quadjax.vehicle.airframe import GRAVITY

LEAST_ROWS = 50  # of a log, for the filters
DETERMINANT_SLACK = 0.1  # of a rotation matrix, from 1
MEDIANS = (  # of propeller speeds in flight, rpm: from, to, and what else it may be
    (-np.inf, -100.0, "expected no sign"),
    (-100.0, 2000.0, "is this rad/s (logs.units.rpm)?"),
    (60_000.0, np.inf, "is this electrical speed (pole pairs times the propeller's)?"),
)


@dataclass(frozen=True)
class Recording:
    """Columns of a log by quantity, (n,) or (n, k) in SI and rpm, and their places in the file."""

    path: str
    where: Callable[[int], str]  # place of a sample, for messages
    names: Mapping[str, list[str]]
    quantities: Quantities

    def error(self, row: int, columns: str, problem: str) -> InputError:
        """A problem of some columns at a sample."""
        return InputError(f"{self.path}: {self.where(int(row))}, column {columns}{problem}")

    @property
    def flying(self) -> np.ndarray:
        """Rows in flight: by the log's mode, or else by propeller speed."""
        mode = self.quantities.get("mode")
        if mode is not None and (mode > 0).any():
            return mode > 0
        speeds = self.quantities["rpm" if "rpm" in self.quantities else "motor_command"]
        mean = np.abs(speeds).mean(axis=1)
        return mean >= 0.5 * np.median(mean)


def check_time(log: Recording, config: LogsConfig) -> None:
    """Time must increase without gaps, for long enough, at a plausible rate."""
    time, column = log.quantities["time"], f"{log.names['time'][0]!r}: "
    last = len(time) - 1
    if len(time) < LEAST_ROWS:
        problem = f"the file ends after {len(time)} rows of data, expected at least {LEAST_ROWS}"
        raise log.error(last, column, problem)
    usual, seconds = float(np.median(np.diff(time))), time[-1] - time[0]
    fault = time_fault(time, np.inf)
    if fault is None and not 2e-4 < usual < 0.051:
        problem = f"samples are {usual:.3g} s apart, expected 0.0002 to 0.05 s; is "
        raise log.error(1, column, problem + "logs.units.time right?")
    if fault := fault or time_fault(time, max(config.max_gap, 2.5 * usual)):
        raise log.error(fault[0], column, f"{fault[1]} (logs.max_gap)")
    if seconds < config.min_seconds:
        problem = f"the file ends after {seconds:.3g} s, expected at least {config.min_seconds:g} s"
        raise log.error(last, column, problem)


def check_attitude(log: Recording) -> None:
    """Rotation matrices must have the determinant 1, quaternions a length above 0."""
    for form, word in (("rotation", "determinant"), ("quaternion", "length")):
        if form not in log.quantities:
            continue
        values = log.quantities[form]
        if form == "rotation":
            size = np.linalg.det(values.reshape(-1, 3, 3))
            bad = np.abs(size - 1.0) > DETERMINANT_SLACK
        else:
            size = np.linalg.norm(values, axis=1)
            bad = size == 0.0
        for row in np.flatnonzero(bad)[:1]:
            problem = f"an attitude with a {word} of {size[row]:.3g}, expected 1"
            raise log.error(row, f"{log.names[form][0]!r} and on: ", problem)


def check_columns(log: Recording) -> None:
    """Measurements must not be constant in flight, nor beyond their range in ``QUANTITIES``."""
    flying = log.flying
    for quantity, values in log.quantities.items():
        row = QUANTITIES[quantity]
        for i, (name, column) in enumerate(
            zip(log.names[quantity], np.atleast_2d(values.T), strict=True)
        ):
            if not row.may_be_constant and np.ptp(column[flying]) == 0.0:
                raise InputError(
                    f"{log.path}: column {name!r} is {column[flying][0]:.6g} throughout the "
                    f"flight, expected a measurement of {quantity}"
                )
            if quantity in ("rpm", "rpm_command"):
                _check_median(log, name, column)
            if not row.range:
                continue
            low, high = (np.broadcast_to(bound, row.width)[i] for bound in row.range)
            beyond = (column < low) | (column > high)
            if quantity == "motor_command":
                beyond &= flying
            for sample in np.flatnonzero(beyond)[:1]:
                problem = f" is {column[sample]:.4g} {row.si}, expected {low:g} to {high:g}"
                question = f"; is {row.hint}?" if row.hint else ""
                raise log.error(sample, repr(name), problem + question)


def _check_median(log: Recording, name: str, speeds: np.ndarray) -> None:
    rows = np.flatnonzero(log.flying)
    middle = float(np.median(speeds[rows]))
    for low, high, hint in MEDIANS:
        if low < middle < high:
            problem = f"a median of {middle:.4g} rpm in flight; {hint}"
            raise log.error(rows[0], f"{name!r} and on: ", problem)


def check_levels(log: Recording, largest: float) -> None:
    """The motors turn at about the same speed, and at that of their commands.

    Args:
        log: with or without speeds.
        largest: factor between them that is allowed.
    """
    rows, quantities = log.flying, log.quantities
    if "rpm" not in quantities:
        return
    medians = np.median(quantities["rpm"][rows], axis=0)
    for i, name in enumerate(log.names["rpm"]):
        factor = medians[i] / np.delete(medians, i).mean()
        if not 1.0 / largest <= factor <= largest:
            raise InputError(
                f"{log.path}: column {name!r} is {factor:.3g} times the other motors' speeds "
                f"(median {medians[i]:.4g} rpm); allowed: logs.max_scale_error"
            )
    if "rpm_command" in quantities:
        factor = float(np.median(np.median(quantities["rpm_command"][rows], axis=0) / medians))
        if not 1.0 / largest <= factor <= largest:
            names = ", ".join(map(repr, log.names["rpm_command"]))
            raise InputError(
                f"{log.path}: columns {names} are {factor:.3g} times the speeds "
                f"{', '.join(map(repr, log.names['rpm']))} (logs.units.rpm, logs.max_scale_error)"
            )


def check_thrust(log: Recording) -> None:
    """The specific force, in FRD axes, is about that of gravity, along -z."""
    rows, names = np.flatnonzero(log.flying), log.names["acceleration"]
    airborne, column = log.quantities["acceleration"][rows], f"{names[2]!r} and on: "
    size = float(np.median(np.linalg.norm(airborne, axis=1)))
    if not 0.4 * GRAVITY < size < 5.0 * GRAVITY:
        hint = "is this in g (logs" if size < GRAVITY else "is the unit right (logs"
        problem = f"a median of {size:.3g} m/s^2 in flight, expected about {GRAVITY}; {hint}"
        raise log.error(rows[0], column, problem + ".units.acceleration)?")
    middle = np.median(airborne, axis=0)
    largest = int(np.abs(middle).argmax())
    if largest != 2 and middle[2] > -0.5 * abs(middle[largest]):
        problem = f"the thrust is in column {names[largest]!r} ({middle[largest]:+.3g} m/s^2); are "
        raise log.error(rows[0], column, problem + f"{names[2]!r} and {names[largest]!r} swapped?")
    if middle[2] > 0.0:
        problem = f"the specific force points down ({middle[2]:+.3g} m/s^2), expected negative "
        raise log.error(
            rows[0], column, problem + "with z down; is this a z-up frame (logs.body_frame FLU)?"
        )
