"""The model of a racing quadcopter (``quadjax.vehicle.racing``) from flight logs."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors
from quadjax.fitting.config import FitConfig, ResidualConfig
from quadjax.fitting.flight_log import FlightLog, read_logs
from quadjax.fitting.least_squares import AxisFit, check_signs, fit_nominal, r_squared, with_fit
from quadjax.fitting.motor_map import RPM, MotorFit, fit_motors, with_simulated_speeds
from quadjax.fitting.nominal import AXES, EQUATIONS
from quadjax.fitting.pipeline import with_speed
from quadjax.fitting.prepare import Samples, airborne, prepare
from quadjax.fitting.split import GUARD, flight_groups
from quadjax.fitting.tasks import nominal_error
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.vehicle_file import VehicleFile

Report = Callable[[str], None]
MODEL = "racing"


@dataclass(frozen=True)
class HeldOut:
    """What a fit without some rows predicts of them; six numbers, as ``AXES``."""

    name: str  # of the flight
    rmse: np.ndarray
    r_squared: np.ndarray


@dataclass(frozen=True)
class RacingFit:
    """Result of a fit."""

    config: FitConfig
    logs: list[FlightLog]
    by: str  # flight, time: what is held out
    vehicle: VehicleFile  # fitted
    constants: RacingConstants
    axes: list[AxisFit]
    motors: MotorFit
    held_out: list[HeldOut]
    warnings: list[str]


def run_racing_fit(
    config: FitConfig, folder: Path, vehicle: VehicleFile, report: Report = lambda line: None
) -> RacingFit:
    """Fit the constants of the motors, then those of forces and moments.

    Args:
        config: of the fit.
        folder: of the config file, in which named files are looked up as well.
        vehicle: the base vehicle, whose constants are kept where the logs do not determine them.
        report: called with the progress.

    Raises:
        InputError: bad logs, a bad config, or a key of it that has no effect, in one line.
    """
    _check_keys(config)
    base = vehicle.racing
    if config.body.rpm_range is not None:
        low, high = (value / RPM for value in config.body.rpm_range)
        base = base.replace(w_min=low, w_max=high)
    logs = read_logs(config.logs, folder, report)
    by, groups = flight_groups([log.name for log in logs], config.split)
    learned = [log for log in logs if log.name not in config.split.test_flights]
    report("fitting motors, forces and moments")
    motors, axes, constants = _fit(learned, base, config, config.logs.min_seconds)
    if not config.nominal.any_sign:
        check_signs(axes)
    mass = vehicle.mass if config.body.mass is None else config.body.mass
    fitted = dataclasses.replace(vehicle, name=config.body.name, mass=mass)
    fitted = with_speed(fitted.with_constants(MODEL, constants), config, logs)
    report("fitting without the held-out flights")
    held_out = []
    if by == "time":
        first, last = zip(*(_cut(log, config) for log in learned), strict=True)
        held_out = _predicted(last, *_fit(first, base, config)[::2], config)
    elif config.split.leave_one_out:
        for group in groups:
            others = [logs[index] for other in groups if other is not group for index in other]
            fit = _fit(others, base, config)
            held_out += _predicted([logs[index] for index in group], *fit[::2], config)
    tested = [log for log in logs if log.name in config.split.test_flights]
    held_out += _predicted(tested, motors, constants, config)
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
    return RacingFit(config, logs, by, fitted, constants, axes, motors, held_out, warnings)


def _check_keys(config: FitConfig) -> None:
    """Refuse keys without effect on this model."""
    reasons = dict.fromkeys(
        (f"residual.{name}" for name in ResidualConfig.model_fields if name != "fit"),
        "this model has no residual",
    )
    reasons["seed"] = "nothing in the fit of this model is random"
    reasons["nominal.fit"] = "this model has no residual, so nothing would be fitted"
    reasons["body.inertia"] = "the constants of this model are per inertia"
    if config.split.by == "time":
        reasons |= dict.fromkeys(
            ("split.folds", "split.leave_one_out"), "split.by=time holds out the last parts alone"
        )
    default = FitConfig()
    for key, reason in reasons.items():
        value, usual = (attrgetter(key)(section) for section in (config, default))
        if value != usual:
            raise InputError(
                f"{key} is {value!r}, which has no effect on a vehicle of the model {MODEL}: "
                f"{reason}; allowed: {usual!r}"
            )


def _fit(
    logs: Sequence[FlightLog], base: RacingConstants, config: FitConfig, min_seconds: float = 0.0
) -> tuple[MotorFit, list[AxisFit], RacingConstants]:
    """Motors, the axes that are fitted, and all constants, from some flights alone."""
    motors = fit_motors(logs, base, config.prepare)
    simulated = [with_simulated_speeds(log, motors.values) for log in logs]
    samples = prepare(simulated, base, config.prepare, min_seconds)
    fits = fit_nominal(samples, with_common(samples, base), config.nominal.any_sign)
    axes = [fit for fit in fits if fit.axis in config.nominal.axes]
    return motors, axes, with_fit(base, axes).replace(**motors.constants)


def _cut(log: FlightLog, config: FitConfig) -> tuple[FlightLog, FlightLog]:
    """The first part of a flight, ``GUARD`` before its last part, and the flight in that alone."""
    rows = np.flatnonzero(airborne(log, config.prepare))
    start = log.time[rows[int((1.0 - config.split.test_fraction) * len(rows))]]
    first = log[: int(np.searchsorted(log.time, start - GUARD))]
    return first, dataclasses.replace(log, flying=log.flying & (log.time >= start))


def _predicted(
    logs: Sequence[FlightLog], motors: MotorFit, constants: RacingConstants, config: FitConfig
) -> list[HeldOut]:
    """What a fit without some flights predicts of them."""
    parts = []
    for log in logs:
        simulated = with_simulated_speeds(log, motors.values)
        samples = prepare([simulated], constants, config.prepare, 0.0)
        error = nominal_error(samples, constants)
        rmse = np.sqrt((error**2).mean(axis=0))
        parts.append(HeldOut(log.name, rmse, r_squared(samples.measured, samples.measured - error)))
    return parts


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
                found[stem] = Rotors.same(float(value))
    return base.replace(**found)
