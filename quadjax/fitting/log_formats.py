"""Formats of flight logs: names, units and frames of their columns, and how a file is read.

A format is a ``LogFormat``: one of ``FORMATS`` or a user's own object (``"module:OBJECT"``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.imports import load_object
from quadjax.fitting import blackbox, px4, tii
from quadjax.fitting.columns import PAPARAZZI, PLAIN
from quadjax.fitting.csv_table import LogTable, read_csv, read_header

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig

Quantities = dict[str, np.ndarray]
Select = Callable[[list[str]], list[str]]


@dataclass(frozen=True)
class LogFormat:
    """A format of flight logs.

    Attributes:
        columns: names of the columns by quantity (see ``quadjax.fitting.columns.WIDTHS``); motors
            in the order front-left, front-right, rear-right, rear-left.
        alternatives: by quantity further names, used where a log lacks the first ones.
        units: by kind, where they are not SI and rpm (see ``quadjax.fitting.columns.UNITS``).
        body_frame: FRD, FLU, or auto: by the direction of the thrust.
        world_frame: NED, ENU, or auto: by the direction of gravity.
        motor_range: values of a motor command that are 0 and 1.
        motor_setting: the setting with both in the log's head, if it has one.
        settings: rows of a setting and its value precede a CSV file's header.
        adjust: ``(quantities, settings) -> quantities``, called with quantities of ``columns`` by
            name, each (n, k) in SI or rpm, in the log's frames.
        read: ``(path) -> columns``, each (n,) by name, for files that are no CSV tables; None reads
            a CSV file.
    """

    columns: Mapping[str, list[str]]
    alternatives: Mapping[str, tuple[list[str], ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    body_frame: str = "FRD"
    world_frame: str = "NED"
    motor_range: tuple[float, float] = (0.0, 1.0)
    motor_setting: str = ""
    settings: bool = False
    adjust: Callable[[Quantities, Mapping[str, str]], Quantities] | None = None
    read: Callable[[Path], Mapping[str, np.ndarray]] | None = None

    def header(self, path: Path | str) -> list[str]:
        """Names of the columns of a file."""
        if self.read is None:
            return read_header(path, self.settings)
        return list(_own_columns(self.read, path))

    def table(self, path: Path | str, select: Select) -> LogTable:
        """Columns of a file; ``select`` takes those to read from the names of all.

        Raises:
            InputError: a file that cannot be read, or a cell that is no finite number.
        """
        if self.read is None:
            return read_csv(path, select, self.settings)
        columns = _own_columns(self.read, path)
        return table_of_columns(columns, path, select(list(columns)))

    def adjusted(
        self, path: Path | str, quantities: Quantities, settings: Mapping[str, str]
    ) -> Quantities:
        """The quantities after ``adjust``.

        Raises:
            InputError: of whatever ``adjust`` raises.
        """
        if self.adjust is None:
            return quantities
        try:
            return self.adjust(quantities, settings)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except USER_ERRORS as error:
            raise InputError(f"{path}: {user_error(error)}") from error


def table_of_columns(
    columns: Mapping[str, np.ndarray], path: Path | str, names: list[str]
) -> LogTable:
    """Some columns (n,) as a table.

    Raises:
        InputError: a missing column, columns of different lengths, or a number that is not finite.
    """
    found = {}
    for name in names:
        if name not in columns:
            raise InputError(f"{path}: column {name!r} is missing")
        found[name] = values = np.asarray(columns[name], np.float64)
        length = len(found[names[0]])
        if values.shape != (length,):
            raise InputError(
                f"{path}: column {name!r} has shape {values.shape}, expected ({length},)"
            )
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise InputError(
                f"{path}: sample {bad[0]}, column {name!r} is {values[bad[0]]}, expected a finite "
                "number"
            )
    return LogTable(found)


def _own_columns(
    read: Callable[[Path], Mapping[str, np.ndarray]], path: Path | str
) -> Mapping[str, np.ndarray]:
    try:
        columns = read(Path(path))
    except InputError:
        raise
    except USER_ERRORS as error:
        raise InputError(f"{path}: {user_error(error)}") from error
    if not isinstance(columns, Mapping):
        raise InputError(f"{path}: the reader gives {columns!r:.40}, expected columns by name")
    return columns


FORMATS: dict[str, LogFormat] = {
    "plain": LogFormat(PLAIN),
    "paparazzi": LogFormat(PAPARAZZI),
    "blackbox": LogFormat(
        blackbox.COLUMNS,
        blackbox.ALTERNATIVES,
        blackbox.UNITS,
        motor_range=blackbox.MOTOR_RANGE,
        motor_setting="motorOutput",
        settings=True,
        adjust=blackbox.adjust,
    ),
    "tii": LogFormat(tii.COLUMNS, body_frame="auto", world_frame="auto", adjust=tii.adjust),
    "ulog": LogFormat(px4.COLUMNS, units={"time": "us"}, read=px4.read_ulog),
}


def log_format(reference: str) -> LogFormat:
    """A format by name, or a user's own (``"module:OBJECT"``).

    Raises:
        InputError: no such format.
    """
    if reference in FORMATS:
        return FORMATS[reference]
    allowed = f"{', '.join(FORMATS)} or 'module:OBJECT'"
    if ":" not in reference:
        raise InputError(f"logs.format is {reference!r}, allowed: {allowed}")
    found = load_object(reference, "logs.format")
    if not isinstance(found, LogFormat):
        raise InputError(f"logs.format is {reference!r}: not a LogFormat; allowed: {allowed}")
    return found


def resolved(config: "LogsConfig") -> "LogsConfig":
    """The config with the units and frames of its format where it gives none."""
    own = log_format(config.format)
    units = {name: own.units.get(name) for name in own.units if getattr(config.units, name) is None}
    return config.replace(
        units=config.units.replace(**units),
        body_frame=config.body_frame or own.body_frame,
        world_frame=config.world_frame or own.world_frame,
    )
