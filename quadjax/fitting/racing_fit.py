"""The model of a racing quadcopter (``quadjax.vehicle.racing``) from flight logs."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.yaml_files import find_file, read_yaml
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import FlightLog, read_logs
from quadjax.fitting.least_squares import AxisFit, check_signs, fit_nominal, r_squared, with_fit
from quadjax.fitting.motor_map import RPM, MotorFit, fit_motors, with_simulated_speeds
from quadjax.fitting.nominal import AXES, EQUATIONS
from quadjax.fitting.prepare import Samples, prepare
from quadjax.fitting.tasks import nominal_error
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.vehicle_file import vehicle_values

Report = Callable[[str], None]
MODEL = "racing"


@dataclass(frozen=True)
class HeldOut:
    """What a fit without some rows predicts of them; six numbers, as ``AXES``."""

    name: str
    rmse: np.ndarray
    r_squared: np.ndarray


@dataclass(frozen=True)
class RacingFit:
    """Result of a fit."""

    config: FitConfig
    logs: list[FlightLog]
    samples: Samples
    constants: RacingConstants
    axes: list[AxisFit]
    motors: MotorFit
    held_out: list[HeldOut]
    warnings: list[str]


def read_racing_vehicle(name: str, folder: Path = Path()) -> RacingConstants | None:
    """The constants of a vehicle file of the model ``racing``; None for a file of another model.

    Raises:
        InputError: a missing file or constant, or a value that is not a number.
    """
    path = find_file(name, folder, "vehicles")
    tree = read_yaml(path)
    if tree.get("model") != MODEL:
        return None
    values = vehicle_values(path, tree)["models"].get(MODEL, {})
    found = {}
    for field in dataclasses.fields(RacingConstants):
        value = values.get(field.name, values.get(field.name.rstrip("1234")))
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{path}: {MODEL}.{field.name} is {value!r}, expected a finite number")
        found[field.name] = float(value)
    return RacingConstants(**found)


def run_racing_fit(
    config: FitConfig, folder: Path, base: RacingConstants, report: Report = lambda line: None
) -> RacingFit:
    """Fit the constants of the motors, then those of forces and moments.

    Args:
        config: of the fit; body.inertia and residual are not used.
        folder: of the config file, in which named files are looked up as well.
        base: values of constants that the logs do not determine.
        report: called with the progress.

    Raises:
        InputError: bad logs or a bad config, in one line.
    """
    if config.body.rpm_range is not None:
        low, high = (value / RPM for value in config.body.rpm_range)
        base = base.replace(w_min=low, w_max=high)
    report("reading the logs")
    logs = read_logs(config.logs, folder)
    report("fitting the motors")
    motors = fit_motors(logs, base, config.prepare)
    logs = [with_simulated_speeds(log, motors.values) for log in logs]
    report("fitting forces and moments")
    samples = prepare(logs, base, config.prepare, config.logs.min_seconds)
    axes = fit_nominal(samples, with_common(samples, base), config.nominal.any_sign)
    if not config.nominal.any_sign:
        check_signs(axes)
    kept = [fit for fit in axes if fit.axis in config.nominal.axes]
    constants = with_fit(base, kept).replace(**motors.constants)
    warnings = [*motors.warnings, *(line for fit in axes for line in fit.warnings)]
    warnings += [
        f"{log.name}: row {log.cut_row} is left out: it may be cut" for log in logs if log.cut_row
    ]
    warnings += [
        f"{log.name}: not checked for lack of motion or of columns to compare with: "
        + ", ".join(log.unchecked)
        for log in logs
        if log.unchecked
    ]
    held_out = list(_held_out(config, logs, samples, base))
    return RacingFit(config, logs, samples, constants, axes, motors, held_out, warnings)


def with_common(samples: Samples, base: RacingConstants) -> RacingConstants:
    """The base vehicle's constants with those of the rotors replaced by ones common to all four.

    They are the values of rotors that the logs do not tell apart. Common values that are not above
    zero are not used.
    """
    found = {}
    for axis, names in EQUATIONS[RacingConstants].constants.items():
        stems = list(dict.fromkeys(name.rstrip("1234") for name in names))
        if len(stems) == len(names):
            continue
        columns = np.stack(
            [
                samples.regressors[axis][:, [n.rstrip("1234") == stem for n in names]].sum(axis=1)
                for stem in stems
            ],
            axis=1,
        )
        # About their means: unequal rotors balance each other in hover.
        columns, target = columns - columns.mean(axis=0), samples.measured[:, AXES.index(axis)]
        target = target - target.mean()
        size = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
        values = np.linalg.lstsq(columns / size, target, rcond=1e-6)[0] / size
        for stem, value in zip(stems, values, strict=True):
            if value > 0.0:
                found |= {f"{stem}{rotor}": float(value) for rotor in (1, 2, 3, 4)}
    return base.replace(**found)


def _held_out(
    config: FitConfig, logs: list[FlightLog], samples: Samples, base: RacingConstants
) -> list[HeldOut]:
    """Each flight by a fit without it; the last part of the only flight, or of each by time."""
    parts = {log.name: samples.flight == index for index, log in enumerate(logs)}
    if len(logs) == 1 or config.split.by == "time":
        last = np.zeros(len(samples), bool)
        for rows in parts.values():
            own = np.flatnonzero(rows)
            last[own[int((1.0 - config.split.test_fraction) * len(own)) :]] = True
        parts = {"last part": last}
    found = []
    for name, rows in parts.items():
        known = samples[~rows]
        start = with_common(known, base)
        constants = with_fit(start, fit_nominal(known, start, config.nominal.any_sign))
        own = samples[rows]
        error = nominal_error(own, constants)
        modeled = own.measured - error
        rmse = np.sqrt((error**2).mean(axis=0))
        found.append(HeldOut(name, rmse, r_squared(own.measured, modeled)))
    return found
