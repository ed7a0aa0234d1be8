"""A complete fit: logs in, vehicle constants, residual networks and evaluation out."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.fitting.config import BodyConfig, FitConfig
from quadjax.fitting.flight_log import FlightLog, highest_speed, read_logs
from quadjax.fitting.lag import LagFit, fit_motor_lag
from quadjax.fitting.least_squares import AxisFit, check_signs, fit_nominal
from quadjax.fitting.nominal import AXES, CONSTANTS
from quadjax.fitting.prediction import (
    Prediction,
    harmful_constants,
    harmless_gains,
    limited_by_others,
    predict,
    with_gains,
)
from quadjax.fitting.prepare import Samples, airborne, prepare
from quadjax.fitting.rate_model import RateFit, fit_rate_model
from quadjax.fitting.residual_fit import (
    ALL,
    LeftOut,
    ResidualFit,
    fit_residuals,
    outer_sets,
    zero_residual,
)
from quadjax.fitting.split import TEST, Split, make_split
from quadjax.fitting.tasks import learned_rows, nominal_without
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

Report = Callable[[str], None]


@dataclass(frozen=True)
class FitResult:
    """Result of a fit."""

    config: FitConfig
    logs: list[FlightLog]
    samples: Samples
    split: Split
    vehicle: VehicleFile  # fitted
    axes: list[AxisFit]
    lag: LagFit
    rate: RateFit | None  # the rate-and-thrust model, if the logs have its commands
    fits: dict[LeftOut, ResidualFit]
    training: Prediction  # the final model on its own rows
    held_out: list[Prediction]  # each by a fit without it, with the factors of the others' errors
    unlimited: list[Prediction]  # the same without factors
    gains: np.ndarray  # (4,) factors on the written residual's outputs, from all of ``unlimited``
    harmful: dict[str, str]  # why axes keep the base vehicle's constants
    warnings: list[str]


def run_fit(config: FitConfig, folder: Path, report: Report = lambda line: None) -> FitResult:
    """Fit the nominal model and the residual networks.

    Args:
        config: of the fit.
        folder: of the config file, in which named files are looked up as well.
        report: called with the progress.

    Raises:
        InputError: bad logs or a bad config, in one line.
    """
    enable_compilation_cache()
    base, logs, samples = _read(config, folder, report)
    flights = [log.name for log in logs]
    split = make_split(samples, flights, config.split)
    report("fitting the nominal model")
    learned = samples[learned_rows(split.fold, ALL)]
    axes = fit_nominal(learned, base.motor, config.nominal.any_sign)
    if not config.nominal.any_sign:
        check_signs(axes)
    lag, rate = _fit_lags(config, logs, samples, base)
    models = _NominalModels(config, samples, split, flights, base.motor)
    harmful = models.harmful(ALL)
    vehicle = base
    if config.nominal.fit:
        motor = models.without(ALL).replace(tau=lag.tau)
        vehicle = _fitted_vehicle(base, motor, rate, config, logs)
    fits = _fit_residuals(config, samples, split, base, models, report)
    held_out = [
        predict(name, samples, rows, fits[left_out])
        for name, rows, left_out in _held_out_rows(samples, split, flights)
        if left_out in fits
    ]
    gains = harmless_gains(held_out, config.residual.max_harm, config.residual.min_gain)
    fits = {
        left_out: dataclasses.replace(fit, residual=with_gains(fit.residual, gains))
        for left_out, fit in fits.items()
    }
    training = predict("training", samples, learned_rows(split.fold, ALL), fits[ALL])
    limited = limited_by_others(held_out, config.residual.max_harm, config.residual.min_gain)
    warnings = _warnings(config, logs, axes, lag, rate) + list(harmful.values())
    warnings += _limits(held_out, gains)
    data = (config, logs, samples, split, vehicle, axes, lag, rate)
    return FitResult(*data, fits, training, limited, held_out, gains, harmful, warnings)


def _fitted_vehicle(
    base: VehicleFile,
    motor: MotorConstants,
    rate: RateFit | None,
    config: FitConfig,
    logs: list[FlightLog],
) -> VehicleFile:
    """The base vehicle with fitted constants, and the highest speed of the flights."""
    vehicle = base.with_constants("motor", motor)
    if rate is not None:
        vehicle = vehicle.with_constants("rate", base.models["rate"] | rate.values)
    return with_speed(vehicle, config, logs)


def with_speed(vehicle: VehicleFile, config: FitConfig, logs: list[FlightLog]) -> VehicleFile:
    """The vehicle, whose ``fitted_speed``, if it has one, becomes that of the fitted flights."""
    if vehicle.fitted_speed is None:
        return vehicle
    fitted = [log for log in logs if log.name not in config.split.test_flights]
    return dataclasses.replace(vehicle, fitted_speed=highest_speed(fitted))


def with_body(base: VehicleFile, body: BodyConfig) -> VehicleFile:
    """The base vehicle with the config's name, mass, inertia and rpm range.

    Mass and width of the base vehicle are those of a drone with its inertia.

    Raises:
        InputError: no inertia.
    """
    if body.inertia is None:
        raise InputError(
            "body.inertia is null; logs do not determine it, and all moments are proportional to "
            f"it: set [xx, yy, zz] in kg m^2, or base for that of {base.name}"
        )
    same = body.inertia == "base"
    values = dict(values_of(base.motor))
    if body.inertia != "base":
        values |= dict(zip(("i_xx", "i_yy", "i_zz"), body.inertia, strict=True))
    if body.rpm_range is not None:
        values |= dict(zip(("rpm_min", "rpm_max"), body.rpm_range, strict=True))
    mass = body.mass if body.mass is not None or not same else base.mass
    width = base.width if same else None
    drone = dataclasses.replace(base, name=body.name, mass=mass, width=width)
    return drone.with_constants("motor", values)


def _read(
    config: FitConfig, folder: Path, report: Report
) -> tuple[VehicleFile, list[FlightLog], Samples]:
    """The base vehicle with the body's numbers, the logs, and their samples."""
    base = with_body(read_vehicle(config.vehicle, folder), config.body)
    logs = read_logs(config.logs, folder, report)
    for log in logs:
        if not log.speeds_measured:
            raise InputError(
                f"{log.path}: no columns for rpm (logs.columns.rpm), which the model motor needs; "
                "motor commands suffice for a racing quadcopter (vehicle=5inch.yaml)"
            )
    report("preparing the samples")
    samples = prepare(logs, base.motor, config.prepare, config.logs.min_seconds)
    most = config.logs.max_scale_error
    return _with_rpm_range(base, config.body, most, logs, samples), logs, samples


def _fit_lags(
    config: FitConfig, logs: list[FlightLog], samples: Samples, base: VehicleFile
) -> tuple[LagFit, RateFit | None]:
    """The motors' lag and the rate-and-thrust model, without the test flights."""
    flying = [airborne(log, config.prepare) for log in logs]
    known = [i for i, log in enumerate(logs) if log.name not in config.split.test_flights]
    lag = fit_motor_lag([logs[i] for i in known], [flying[i] for i in known], float(base.motor.tau))
    if "rate" not in base.models:
        return lag, None
    return lag, fit_rate_model(logs, flying, known, samples, base.models["rate"])


def _with_rpm_range(
    base: VehicleFile,
    body: BodyConfig,
    max_scale_error: float,
    logs: list[FlightLog],
    samples: Samples,
) -> VehicleFile:
    """The range of the flights, rounded outwards to hundreds, unless the config has one.

    Raises:
        InputError: a flight faster than the config's range by more than the allowed scale error.
    """
    if body.rpm_range is not None:
        most = body.rpm_range[1] * (1.0 + max_scale_error)
        for log in logs:
            fastest = float(np.percentile(log.rpm, 99.0))
            if fastest > most:
                raise InputError(
                    f"{log.path}: speeds of up to {fastest:.5g} rpm, body.rpm_range is "
                    f"{list(body.rpm_range)}; is logs.units.rpm right?"
                )
        return base
    used = [samples.motion.rpm] + [log.rpm_command for log in logs if log.rpm_command is not None]
    low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
    high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
    return base.with_constants("motor", base.motor.replace(rpm_min=max(low, 0.0), rpm_max=high))


class _NominalModels:
    """Nominal models without some folds, with the base's constants on axes where those are better.

    Whether they are is decided on the folds that are not left out, each by a fit without it, too,
    and on the test rows.
    """

    def __init__(
        self,
        config: FitConfig,
        samples: Samples,
        split: Split,
        flights: list[str],
        base: MotorConstants,
    ) -> None:
        self.config, self.samples, self.split, self.base = config, samples, split, base
        self.parts = list(_held_out_rows(samples, split, flights))
        self._fitted: dict[LeftOut, MotorConstants] = {}

    def _fit(self, left_out: LeftOut) -> MotorConstants:
        if left_out not in self._fitted:
            self._fitted[left_out] = nominal_without(
                self.samples, self.split.fold, left_out, self.base, self.config.nominal
            )
        return self._fitted[left_out]

    def harmful(self, left_out: LeftOut) -> dict[str, str]:
        """A line for each axis on which the base vehicle's constants are kept."""
        left_out = left_out if self.split.by == "flight" else ALL  # one choice for all blocks
        parts = {
            name: (rows, self._fit(left_out | fold))
            for name, rows, fold in self.parts
            if not (fold and fold <= left_out) and len(left_out | fold) < self.split.folds
        }
        return harmful_constants(self.samples, parts, self.base, self.config.residual.max_harm)

    def without(self, left_out: LeftOut) -> MotorConstants:
        """The constants fitted without some folds."""
        names = [name for axis in self.harmful(left_out) for name in CONSTANTS[axis]]
        return self._fit(left_out).replace(**{name: getattr(self.base, name) for name in names})


def _fit_residuals(
    config: FitConfig,
    samples: Samples,
    split: Split,
    base: VehicleFile,
    models: _NominalModels,
    report: Report,
) -> dict[LeftOut, ResidualFit]:
    leave_one_out = config.split.leave_one_out and split.by == "flight" and split.folds > 1
    if config.residual.fit:
        options = (config.residual, config.seed, leave_one_out, models.without, report)
        return fit_residuals(samples, split, base.motor, *options)
    zero = zero_residual(base.motor)
    return {
        s: ResidualFit(models.without(s), zero, {}, {}) for s in outer_sets(split, leave_one_out)
    }


def _held_out_rows(
    samples: Samples, split: Split, flights: list[str]
) -> Iterator[tuple[str, np.ndarray, LeftOut]]:
    """Name, rows (n,) bool, and the folds to leave out, of every held-out part of the logs."""
    if split.by == "flight" and split.folds > 1:
        for number, name in enumerate(split.names):
            yield name, split.fold == number, frozenset({number})
    for index, name in enumerate(flights):
        rows = (split.fold == TEST) & (samples.flight == index)
        if rows.any():
            yield (name if split.by == "flight" else f"{name}, last part"), rows, ALL


def _limits(held_out: list[Prediction], gains: np.ndarray) -> list[str]:
    """A line for each of the residual's outputs that is scaled down to limit a flight's error."""
    lines = []
    for axis, gain in zip(AXES[2:], gains, strict=True):
        if gain < 1.0:
            worst = max(held_out, key=lambda part: part.change[AXES.index(axis)])
            harm = 100.0 * worst.change[AXES.index(axis)]
            what = f"scaled by {gain:.2f}" if gain else "written as zero"
            lines.append(
                f"{axis}: the residual is {what}, because the full one changes the error on "
                f"{worst.name}, held out, by {harm:+.0f}%"
            )
    return lines


def _warnings(
    config: FitConfig,
    logs: list[FlightLog],
    axes: list[AxisFit],
    lag: LagFit,
    rate: RateFit | None,
) -> list[str]:
    lines = [line for axis in axes for line in axis.warnings]
    lines += [lag.warning] if lag.warning else []
    lines += rate.warnings if rate else ()
    if config.body.rpm_range is None and all(log.rpm_command is None for log in logs):
        lines.append(
            "the common scale of the propeller speeds is not checked: the logs have no commanded "
            "speeds; body.rpm_range, if given, bounds it"
        )
    lines += [
        f"{log.name}: row {log.cut_row} is left out: no line break ends it, so it may be cut"
        for log in logs
        if log.cut_row
    ]
    return lines + [
        f"{log.name}: not checked for lack of motion or of columns to compare with: "
        + ", ".join(log.unchecked)
        for log in logs
        if log.unchecked
    ]
