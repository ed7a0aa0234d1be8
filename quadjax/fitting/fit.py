"""A complete fit: logs in; constants, residual networks and errors on held-out flights out."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.fitting.config import BodyConfig, FitConfig, ResidualConfig
from quadjax.fitting.flight_log import FlightLog, highest_speed, read_logs
from quadjax.fitting.lag import BatteryFit, fit_motor_lag
from quadjax.fitting.motor_map import RPM
from quadjax.fitting.nominal import Constants
from quadjax.fitting.nominal_fits import MotorFits, NominalFits, RacingFits
from quadjax.fitting.prediction import Prediction, predict
from quadjax.fitting.prepare import Samples, flight_rows
from quadjax.fitting.rate_model import fit_rate_model
from quadjax.fitting.regression import Estimate, check_signs
from quadjax.fitting.residual_fit import ResidualFit, fit_residuals, zero_residual
from quadjax.fitting.split import ALL, LeftOut, Split, make_split
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

Report = Callable[[str], None]
BATTERY = BatteryConfig()


@dataclass(frozen=True)
class Fit:
    """The result of a fit.

    Attributes:
        config: of the fit.
        logs: the flights.
        model: that is fitted, ``motor`` or ``racing``.
        vehicle: the fitted drone.
        samples: every row in flight, as the written model has them.
        split: of these rows.
        estimates: the fitted constants, by axis and what else they belong to.
        constants: of each complete fit, by the folds left out; ``ALL`` is the written one.
        residuals: of each complete fit; empty for a model without one.
        training: the written model on its own rows.
        held_out: predictions, each by a complete fit without the flight.
        kept: why axes keep the base vehicle's constants, by axis.
        battery: the limit of the propeller speeds; None without commanded speeds.
        warnings: one line each.
    """

    config: FitConfig
    logs: list[FlightLog]
    model: str
    vehicle: VehicleFile
    samples: Samples
    split: Split
    estimates: list[Estimate]
    constants: dict[LeftOut, Constants]
    residuals: dict[LeftOut, ResidualFit]
    training: Prediction
    held_out: list[Prediction]
    kept: dict[str, str]
    battery: BatteryFit | None
    warnings: list[str]

    @property
    def fitted_flights(self) -> list[str]:
        """Names of the flights that are fitted, all but the test flights."""
        return [log.name for log in self.logs if log.name not in self.config.split.test_flights]


def fit(
    config: FitConfig,
    folder: Path = Path(),
    report: Report = lambda line: None,
    battery: BatteryConfig = BATTERY,
) -> Fit:
    """Fit a drone's model to its flight logs: that of the base vehicle, ``motor`` or ``racing``.

    Every held-out flight is predicted by a complete fit without it: constants, residual and all
    choices. By time the last part of each flight is not fitted at all.

    Args:
        config: of the fit.
        folder: of the config file, in which named files are looked up as well.
        report: called with the progress.
        battery: whose numbers are assumed where the flights do not show them.

    Raises:
        InputError: bad logs, a bad config, or a key of it that has no effect, in one line.
    """
    enable_compilation_cache()
    vehicle = read_vehicle(config.vehicle, folder)
    model = "racing" if vehicle.model == "racing" else "motor"
    base = with_body(vehicle, config.body, model)
    logs = read_logs(config.logs, folder, report)
    _check_speeds(config, logs, model)
    report("preparing the samples")
    rows = flight_rows(logs, config.logs.min_seconds)
    split = _split(config, logs, rows)
    check_keys(config, model, split)
    report("fitting the constants")
    fits: NominalFits
    if model == "racing":
        fits = RacingFits(config, logs, rows, split, base.racing)
    else:
        fits = MotorFits(config, logs, rows, split, base.motor)
        base = _with_rpm_range(base, config.body, logs, fits.samples())
        fits.base = base.motor
    check_signs(fits.estimates())
    complete = split.complete(config.split.leave_one_out)
    constants = {left_out: fits.constants(left_out) for left_out in complete}
    residuals: dict[LeftOut, ResidualFit] = {}
    others, limit = [], None
    if isinstance(fits, MotorFits):
        residuals = _residuals(config, fits, complete, report)
        others, limit = _lags(fits, base, battery)
    estimates = [*fits.estimates(), *others]

    def predicted(name: str, mask: np.ndarray, left_out: LeftOut) -> Prediction:
        residual = residuals[left_out].residual if residuals else None
        return predict(name, fits.samples(left_out), mask, constants[left_out], residual)

    samples = fits.samples()
    names = [log.name for log in logs]
    parts = split.held_out(samples.flight, names, config.split.leave_one_out)
    kept = fits.harmful()
    return Fit(
        config=config,
        logs=logs,
        model=model,
        vehicle=_fitted(base, model, constants[ALL], others, config, logs),
        samples=samples,
        split=split,
        estimates=estimates,
        constants=constants,
        residuals=residuals,
        training=predicted("training", split.learned(ALL), ALL),
        held_out=[predicted(*part) for part in parts],
        kept=kept,
        battery=limit,
        warnings=[*_warnings(config, logs, estimates), *kept.values()],
    )


def with_body(base: VehicleFile, body: BodyConfig, model: str = "motor") -> VehicleFile:
    """The base vehicle with the config's name, mass, inertia and rpm range.

    Mass and width of the base vehicle are those of a drone with its inertia.

    Raises:
        InputError: no inertia for the model ``motor``.
    """
    values = dict(values_of(base.constants(model)))
    same = model == "racing" or body.inertia == "base"
    if body.rpm_range is not None:
        low, high = body.rpm_range
        if model == "racing":
            values |= {"w_min": low / RPM, "w_max": high / RPM}
        else:
            values |= {"rpm_min": low, "rpm_max": high}
    if not same:
        if body.inertia is None:
            raise InputError(
                "body.inertia is null; logs do not determine it, and all moments are proportional "
                f"to it: set [xx, yy, zz] in kg m^2, or base for that of {base.name}"
            )
        values |= dict(zip(("i_xx", "i_yy", "i_zz"), map(float, body.inertia), strict=True))
    mass = base.mass if same and body.mass is None else body.mass
    width = base.width if same else None
    drone = replace(base, name=body.name, mass=mass, width=width)
    return drone.with_constants(model, values)


def check_keys(config: FitConfig, model: str, split: Split) -> None:
    """Refuse keys without effect.

    Raises:
        InputError: naming the key, its value, the reason and what is allowed.
    """
    reasons: dict[str, str] = {}
    training = [f"residual.{name}" for name in ResidualConfig.model_fields if name != "fit"]
    if split.by == "time":
        reasons["split.leave_one_out"] = "by time the last parts alone are held out"
    else:
        reasons["split.test_fraction"] = "whole flights are held out"
    if not config.nominal.fit:
        reasons["nominal.axes"] = "nominal.fit=false fits no constant"
    if not config.residual.fit:
        reason = "residual.fit=false trains no network"
        reasons |= dict.fromkeys([key for key in training if key != "residual.max_harm"], reason)
        reasons["seed"] = "without a residual nothing is random"
    if model == "racing":
        of_model = "on a vehicle of the model racing: "
        reasons |= dict.fromkeys(training, f"{of_model}it has no residual")
        reasons["seed"] = f"{of_model}nothing in its fit is random"
        reasons["nominal.fit"] = f"{of_model}without its constants nothing would be fitted"
        reasons["body.inertia"] = f"{of_model}its constants are per inertia"
        if split.by == "time":
            reasons["split.folds"] = f"{of_model}no choice is validated on blocks of time"
    for key, reason in reasons.items():
        value, usual = (attrgetter(key)(section) for section in (config, FitConfig()))
        if value != usual:
            raise InputError(
                f"{key} is {value!r}, which has no effect: {reason}; allowed: {usual!r}"
            )


def _check_speeds(config: FitConfig, logs: list[FlightLog], model: str) -> None:
    """Refuse logs that lack what the model needs, or are of another drone.

    Raises:
        InputError: a log without speeds, or faster than the config's range by more than the allowed
            scale error.
    """
    for log in logs:
        if model == "motor" and not log.speeds_measured:
            raise InputError(
                f"{log.path}: no columns for rpm (logs.columns.rpm), which the model motor needs; "
                "motor commands suffice for a racing quadcopter (vehicle=5inch.yaml)"
            )
        if config.body.rpm_range is None or not log.speeds_measured:
            continue
        fastest = float(np.percentile(log.rpm, 99.0))
        if fastest > config.body.rpm_range[1] * (1.0 + config.logs.max_scale_error):
            raise InputError(
                f"{log.path}: speeds of up to {fastest:.5g} rpm, body.rpm_range is "
                f"{list(config.body.rpm_range)}; is logs.units.rpm right?"
            )


def _split(config: FitConfig, logs: list[FlightLog], rows: list[np.ndarray]) -> Split:
    flight = np.repeat(np.arange(len(logs)), [int(used.sum()) for used in rows])
    times = [log.time[used] - log.time[0] for log, used in zip(logs, rows, strict=True)]
    return make_split(flight, np.concatenate(times), [log.name for log in logs], config.split)


def _with_rpm_range(
    base: VehicleFile, body: BodyConfig, logs: list[FlightLog], samples: Samples
) -> VehicleFile:
    """The range of the flights, rounded outwards to hundreds, unless the config has one."""
    if body.rpm_range is not None:
        return base
    used = [samples.motion.rpm] + [log.rpm_command for log in logs if log.rpm_command is not None]
    low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
    high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
    return base.with_constants("motor", base.motor.replace(rpm_min=max(low, 0.0), rpm_max=high))


def _residuals(
    config: FitConfig, fits: MotorFits, complete: list[LeftOut], report: Report
) -> dict[LeftOut, ResidualFit]:
    if not config.residual.fit:
        return dict.fromkeys(complete, zero_residual(fits.base))
    samples, split = fits.samples(), fits.split
    options = (complete, config.residual, config.seed, report)
    return fit_residuals(samples, split, fits.base, fits.constants, *options)


def _lags(
    fits: MotorFits, base: VehicleFile, battery: BatteryConfig
) -> tuple[list[Estimate], BatteryFit | None]:
    """The motors' lag with the battery's limit, and the rate-and-thrust model."""
    logs, rows = fits.logs, fits.masks()
    constants = fits.constants()
    hover = float(np.sqrt(constants.g / (4.0 * constants.k_w)))
    lag, limit = fit_motor_lag(logs, rows, float(fits.base.tau), hover, battery)
    rate = []
    if "rate" in base.models:
        rate = fit_rate_model(logs, rows, base.constants("rate"), fits.config.prepare.cutoff)
    return [lag, *rate], limit


def _fitted(
    base: VehicleFile,
    model: str,
    constants: Constants,
    others: list[Estimate],
    config: FitConfig,
    logs: list[FlightLog],
) -> VehicleFile:
    """The base vehicle with fitted constants; its ``fitted_speed`` is that of the flights."""
    if not config.nominal.fit:
        return base
    vehicle = base.with_constants(model, constants)
    for estimate in others:
        of = "rate" if estimate.group == "rate" else "motor"
        names = vehicle.models[of]
        found = {name: x for name, x in estimate.constants.items() if name in names}
        vehicle = vehicle.with_constants(of, names | found)
    if vehicle.fitted_speed is None:
        return vehicle
    fitted = [log for log in logs if log.name not in config.split.test_flights]
    return replace(vehicle, fitted_speed=highest_speed(fitted))


def _warnings(config: FitConfig, logs: list[FlightLog], estimates: list[Estimate]) -> Iterator[str]:
    for estimate in estimates:
        yield from estimate.warnings
    scaled = any(log.rpm_command is not None or log.motor_command is not None for log in logs)
    if config.body.rpm_range is None and not scaled:
        yield (
            "the common scale of the propeller speeds is not checked: the logs have no commanded "
            "speeds; body.rpm_range, if given, bounds it"
        )
    for log in logs:
        if log.cut_row:
            yield (
                f"{log.name}: row {log.cut_row} is left out: no line break ends it, so it may be "
                "cut"
            )
    for log in logs:
        if log.unchecked:
            yield (
                f"{log.name}: not checked for lack of motion or of columns to compare with: "
                + ", ".join(log.unchecked)
            )
