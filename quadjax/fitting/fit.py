"""A complete fit: logs in; constants, residual networks and errors on held-out flights out."""

from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.precision import single_precision
from quadjax.fitting.axes import Prediction
from quadjax.fitting.config import FitConfig, with_body
from quadjax.fitting.flight_log import read_logs
from quadjax.fitting.magnitudes import scale_hint, unit_hint
from quadjax.fitting.motors import BatteryFit
from quadjax.fitting.nominal import AXES, Constants, units
from quadjax.fitting.nominal_fit import NominalFits
from quadjax.fitting.regression import Estimate, check_signs, r_squared
from quadjax.fitting.residual import ResidualFit, ResidualFits, zero_residual
from quadjax.fitting.samples import CUTOFF_HZ, Folds, Samples, Split, airborne
from quadjax.flights.flight import Flight
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

MAX_THRUST_RATIO = 2.0  # times the base vehicle's thrust

Report = Callable[[str], None]


@dataclass(frozen=True)
class FittedModel:
    """What is fitted to some folds, all choices included."""

    samples: Samples  # every row, as this model has them
    constants: Constants
    residual: ResidualFit | None  # None for a model without one

    def predict(self, name: str, rows: np.ndarray) -> Prediction:
        """Measured and predicted on some rows (n,) bool."""
        residual = self.residual.residual if self.residual else None
        return Prediction.of(name, self.samples, rows, self.constants, residual)


@dataclass(frozen=True)
class Fit:
    """The result of a fit."""

    config: FitConfig  # of the fit
    logs: list[Flight]  # the flights
    model: str  # that is fitted, ``motor`` or ``racing``
    vehicle: VehicleFile  # the fitted drone
    split: Split  # of the rows
    estimates: list[Estimate]  # the fitted constants, by axis and what else they belong to
    fitted: FittedModel  # to all folds; the one that is written
    without: dict[str, FittedModel]  # by the name of the flight, or group, that is left out
    training: Prediction  # the written model on its own rows
    held_out: list[Prediction]  # predictions, each by a complete fit without the flight
    kept: dict[str, str]  # why axes keep the base vehicle's constants, by axis
    battery: BatteryFit | None  # the limit of the propeller speeds; None without commanded speeds
    warnings: list[str]  # one line each

    def __repr__(self) -> str:
        """One line, without the samples."""
        return f"Fit({self.vehicle.name!r}, model {self.model}, {len(self.logs)} logs)"

    @property
    def samples(self) -> Samples:
        """Every row in flight, as the written model has them."""
        return self.fitted.samples

    @property
    def units(self) -> dict[str, str]:
        """The unit of each axis."""
        return units(type(self.fitted.constants))

    def models(self, part: Prediction) -> dict[str, np.ndarray]:
        """What is predicted (n, 6): by the "nominal" model, and with the "residual" if any."""
        residual = {"residual": part.full} if self.fitted.residual else {}
        return {"nominal": part.nominal, **residual}

    @property
    def fitted_flights(self) -> list[str]:
        """Names of the flights that are fitted, all but the test flights."""
        return [log.name for log in self.logs if log.name not in self.config.split.test_flights]


@single_precision
def fit(config: FitConfig, folder: Path = Path(), report: Report = lambda line: None) -> Fit:
    """Fit a drone's model to its flight logs: that of the base vehicle, ``motor`` or ``racing``.

    Every held-out flight is predicted by a complete fit without it: constants, residual and all
    choices. By time the last part of each flight is not fitted at all.

    Args:
        config: of the fit.
        folder: of the config file, in which named files are looked up as well.
        report: called with the progress.

    Raises:
        InputError: bad logs, a bad config, or a key of it that has no effect, in one line.
    """
    enable_compilation_cache()
    vehicle = read_vehicle(config.vehicle, folder)
    model = "motor" if "motor" in vehicle.models and vehicle.model != "racing" else "racing"
    base = with_body(vehicle, config.body, model)
    logs = read_logs(config.logs, folder, report)
    check_logs(config, logs, model)
    report("preparing the samples")
    nominal = NominalFits(config, logs, base, model)
    split = nominal.split
    report("fitting the constants")
    check_signs(nominal.estimates(split.all))
    fit_folds = _complete_fits(nominal)
    report("fitting to all flights")
    fitted = fit_folds(split.all)
    without, held_out = cross_validate(fit_folds, split, report)
    tests = split.tests(fitted.samples.flight, [log.name for log in logs])
    lags, limit = nominal.lags()
    estimates, kept = [*nominal.estimates(split.all), *lags], nominal.kept(split.all)
    training = fitted.predict("training", split.rows(split.all))
    return Fit(
        config=config,
        logs=logs,
        model=model,
        vehicle=nominal.fitted_vehicle(lags),
        split=split,
        estimates=estimates,
        fitted=fitted,
        without=without,
        training=training,
        held_out=[*held_out, *(fitted.predict(name, rows) for name, rows in tests)],
        kept=kept,
        battery=limit,
        warnings=[
            *_warnings(logs, estimates),
            *kept.values(),
            *_unexplained(training, nominal.fitted_axes(split.all)),
            *_scale(logs, estimates, vehicle, model),
        ],
    )


def _complete_fits(nominal: NominalFits) -> Callable[[Folds], FittedModel]:
    """The function that fits constants and residual to some folds."""
    config, split = nominal.config, nominal.split
    residuals: ResidualFits | None = None
    if nominal.model == "motor" and config.residual.fit:
        rows = nominal.samples(split.all), split, nominal.base
        residuals = ResidualFits(*rows, nominal.constants, config.residual, config.seed)

    def fit_folds(folds: Folds) -> FittedModel:
        zero = zero_residual(nominal.base) if nominal.model == "motor" else None
        residual = residuals(folds) if residuals else zero
        return FittedModel(nominal.samples(folds), nominal.constants(folds), residual)

    return fit_folds


def cross_validate(
    fit_folds: Callable[[Folds], FittedModel], split: Split, report: Report
) -> tuple[dict[str, FittedModel], list[Prediction]]:
    """Fit without each flight, or group of flights, and predict it; by time, nothing is fitted.

    Args:
        fit_folds: the complete fit to some folds.
        split: of the rows.
        report: called with the progress.

    Returns:
        The fits by the name of what is left out, and its predictions.
    """
    models: dict[str, FittedModel] = {}
    predictions: list[Prediction] = []
    for number, name in enumerate(split.names if split.by == "flight" else ()):
        report(f"fitting without {name}")
        models[name] = fit_folds(split.all - {number})
        predictions.append(models[name].predict(name, split.rows(frozenset({number}))))
    return models, predictions


def check_logs(config: FitConfig, logs: Sequence[Flight], model: str) -> None:
    """Refuse logs that are too slow, lack what the model needs, or are of another drone.

    Raises:
        InputError: a log of few samples, without speeds, faster than the config's range by more
            than the allowed scale error, or slower than this range for most of the flight.
    """
    for log in logs:
        path, measured = log.source["path"], "actuators" in log.signals
        if log.sample_rate <= 2.0 * CUTOFF_HZ:
            raise InputError(
                f"{path}: a sample rate of {log.sample_rate:.4g} Hz is too low to fit, allowed: "
                f"above {2.0 * CUTOFF_HZ:g} Hz"
            )
        if model == "motor" and not measured:
            raise InputError(
                f"{path}: no columns for rpm (logs.columns.rpm), which the model motor needs; "
                "motor commands suffice for a racing quadcopter (vehicle=5inch.yaml)"
            )
        if config.body.rpm_range is None or not measured:
            continue
        (low, high), speeds = config.body.rpm_range, log["actuators"][airborne(log)]
        highest, unit = high * (1.0 + config.logs.max_scale_error), log.source["rpm_unit"]
        fastest, middle = float(np.percentile(speeds, 99.0)), float(np.median(speeds))
        if not (fastest <= highest and middle >= low):
            found = (
                f"up to {fastest:.5g} rpm" if fastest > highest else f"{middle:.5g} rpm on average"
            )
            raise InputError(
                f"{path}: speeds of {found}, those of the vehicle are {low:g} to {high:g} "
                f"(body.rpm_range), if it is this drone{unit_hint('rpm', middle, unit, low, high)}"
            )


def _unexplained(training: Prediction, fitted: Set[str]) -> Iterator[str]:
    """Axes whose constants are not fitted, and are worse than none."""
    explained = r_squared(training.measured, training.nominal)
    for axis, value in zip(AXES, explained, strict=True):
        if axis not in fitted and value < 0.0:
            yield f"{axis}: R^2 is {value:.3g} with the base vehicle's constants, which are kept"


def _scale(
    logs: Sequence[Flight], estimates: Sequence[Estimate], base: VehicleFile, model: str
) -> Iterator[str]:
    """A thrust unlike the base vehicle's: of another drone, or the scale of the speeds is wrong.

    Commanded speeds, which have the same unit, do not show it, nor do the motors' range of speeds.
    """
    if not all("actuators" in log.signals for log in logs):
        return
    fitted = {name: x for estimate in estimates for name, x in estimate.constants.items()}
    known = float(base.constants(model).k_w)
    change = fitted.get("k_w", known) / known
    if not 1.0 / MAX_THRUST_RATIO < change < MAX_THRUST_RATIO:
        speeds = change**0.5  # of the base vehicle, times those of the logs
        hint = scale_hint("rpm", speeds, logs[0].source["rpm_unit"])
        yield (
            f"k_w is {change:.3g} times that of {base.name}, as of propeller speeds that are "
            f"{1.0 / speeds:.3g} times the true ones, unless it is another drone{hint}"
        )


def _warnings(logs: Sequence[Flight], estimates: Sequence[Estimate]) -> Iterator[str]:
    for estimate in estimates:
        yield from estimate.warnings
    for log in logs:
        if gaps := log.source["gaps"]:
            yield (
                f"{log.name}: {len(gaps)} of the steps between samples are gaps of up to "
                f"{max(gaps):.3g} s: the samples in and next to them are not fitted"
            )
        if names := ", ".join(log.source["left_out"]):
            yield f"{log.name}: not read: {names}"
        if names := ", ".join(log.source["unchecked"]):
            yield (
                f"{log.name}: not checked for lack of motion or of columns to compare with: {names}"
            )
