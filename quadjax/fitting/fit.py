"""A complete fit: logs in; constants, residual networks and errors on held-out flights out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.fitting.axes import Prediction, fit_axes, nominal_error, with_common, with_estimates
from quadjax.fitting.config import FitConfig, check_keys, with_body
from quadjax.fitting.flight_log import highest_speed, read_logs
from quadjax.fitting.motors import (
    BatteryFit,
    fit_battery,
    fit_motors,
    fit_rate_model,
    with_simulated_speeds,
)
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants, units
from quadjax.fitting.regression import Estimate, check_signs
from quadjax.fitting.residual import ResidualFit, fit_residuals, zero_residual
from quadjax.fitting.samples import ALL, LeftOut, Samples, Split, airborne, make_split, prepare
from quadjax.flights.flight import Flight
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

Report = Callable[[str], None]


@dataclass(frozen=True)
class Fit:
    """The result of a fit."""

    config: FitConfig  # of the fit
    logs: list[Flight]  # the flights
    model: str  # that is fitted, ``motor`` or ``racing``
    vehicle: VehicleFile  # the fitted drone
    samples: Samples  # every row in flight, as the written model has them
    split: Split  # of these rows
    estimates: list[Estimate]  # the fitted constants, by axis and what else they belong to
    # of each complete fit, by the folds left out; ``ALL`` is the written one
    constants: Mapping[LeftOut, Constants]
    residuals: dict[LeftOut, ResidualFit]  # of each complete fit; empty for a model without one
    training: Prediction  # the written model on its own rows
    held_out: list[Prediction]  # predictions, each by a complete fit without the flight
    kept: dict[str, str]  # why axes keep the base vehicle's constants, by axis
    battery: BatteryFit | None  # the limit of the propeller speeds; None without commanded speeds
    warnings: list[str]  # one line each

    @property
    def units(self) -> dict[str, str]:
        """The unit of each axis."""
        return units(type(self.constants[ALL]))

    def models(self, part: Prediction) -> dict[str, np.ndarray]:
        """What is predicted (n, 6): by the "nominal" model, and with the "residual" if any."""
        return {"nominal": part.nominal, **({"residual": part.full} if self.residuals else {})}

    @property
    def fitted_flights(self) -> list[str]:
        """Names of the flights that are fitted, all but the test flights."""
        return [log.name for log in self.logs if log.name not in self.config.split.test_flights]


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
    model = "racing" if vehicle.model == "racing" else "motor"
    base = with_body(vehicle, config.body, model)
    logs = read_logs(config.logs, folder, report)
    check_speeds(config, logs, model)
    report("preparing the samples")
    fits = _Fits(config, logs, base, model)
    report("fitting the constants")
    check_signs(fits.estimates())
    complete = fits.split.complete()
    constants = {left_out: fits.constants(left_out) for left_out in complete}
    residuals: dict[LeftOut, ResidualFit] = {}
    if model == "motor" and not config.residual.fit:
        residuals = dict.fromkeys(complete, zero_residual(fits.base))
    elif model == "motor":
        options = fits.constants, config.residual, config.seed, report
        residuals = fit_residuals(fits.samples(), fits.split, fits.base, *options)
    lags, limit = fits.lags()
    estimates = [*fits.estimates(), *lags]
    kept, samples = fits.harmful(), fits.samples()

    def predicted(name: str, mask: np.ndarray, left_out: LeftOut) -> Prediction:
        residual = residuals[left_out].residual if residuals else None
        return Prediction.of(name, fits.samples(left_out), mask, constants[left_out], residual)

    parts = fits.split.held_out(samples.flight, [log.name for log in logs])
    return Fit(
        config=config,
        logs=logs,
        model=model,
        vehicle=fits.fitted_vehicle(lags) if config.nominal.fit else fits.vehicle,
        samples=samples,
        split=fits.split,
        estimates=estimates,
        constants=constants,
        residuals=residuals,
        training=predicted("training", fits.split.learned(ALL), ALL),
        held_out=[predicted(*part) for part in parts],
        kept=kept,
        battery=limit,
        warnings=[*_warnings(config, logs, estimates), *kept.values()],
    )


class _Fits:
    """The constants of a model, fitted without some folds; each fit is computed once.

    ``motor``: an axis keeps the base vehicle's constants where they are better. Whether they are is
    decided on the folds that are not left out, each by a fit without it, too. ``racing``: motors
    are fitted first; their speeds are used where logs have none.
    """

    def __init__(
        self, config: FitConfig, logs: Sequence[Flight], vehicle: VehicleFile, model: str
    ) -> None:
        self.config, self.logs, self.vehicle, self.model = config, logs, vehicle, model
        self.rows = [airborne(log, config.logs.min_seconds) for log in logs]  # (n,) bool of each
        pairs = zip(logs, self.rows, strict=True)
        times = [log.time[used] - log.time[0] for log, used in pairs]
        self.split = make_split(times, [log.name for log in logs], config.split)
        check_keys(config, model, self.split.by)
        self.base: Any = vehicle.constants(model)
        self._fits: dict[LeftOut, tuple[Samples, list[Estimate]]] = {}
        self._measured = all("actuators" in log.signals for log in logs)
        if model == "motor" and config.body.rpm_range is None:
            # The range of the flights, rounded outwards to hundreds.
            used = [
                self.samples().motion.rpm,
                *(log["command"] for log in logs if "command" in log.signals),
            ]
            low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
            high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
            self.base = self.base.replace(rpm_min=max(low, 0.0), rpm_max=high)
            self.vehicle = vehicle.with_constants(model, self.base)

    def samples(self, left_out: LeftOut = ALL) -> Samples:
        """Every row; nothing in them is computed from the folds left out."""
        return self._fit(left_out)[0]

    def estimates(self, left_out: LeftOut = ALL) -> list[Estimate]:
        """The constants that are fitted without some folds, with their errors."""
        return self._fit(left_out)[1]

    def masks(self, left_out: LeftOut = ALL) -> list[np.ndarray]:
        """The rows (n,) bool of each flight that are in flight and not left out."""
        ends = np.cumsum([int(rows.sum()) for rows in self.rows])[:-1]
        masks = [rows.copy() for rows in self.rows]
        for mask, learned in zip(masks, np.split(self.split.learned(left_out), ends), strict=True):
            mask[mask] = learned
        return masks

    def _fit(self, left_out: LeftOut) -> tuple[Samples, list[Estimate]]:
        if left_out in self._fits:
            return self._fits[left_out]
        base, motors, logs = self.base, [], self.logs
        if self.model == "racing":
            motors = [fit_motors(logs, self.masks(left_out), base)]
            values = np.array(list(motors[0].constants.values()))
            logs = [with_simulated_speeds(log, values) for log in logs]
        if self._measured and self._fits:
            samples = next(iter(self._fits.values()))[0]
        else:
            samples = prepare(logs, base, self.rows)
        learned = samples[self.split.learned(left_out)]
        if self.model == "racing":
            base = with_common(learned, base)
        axes = [fit for fit in fit_axes(learned, base) if fit.group in self.config.nominal.axes]
        self._fits[left_out] = samples, [*axes, *motors]
        return self._fits[left_out]

    def _fitted(self, left_out: LeftOut) -> Constants:
        if not self.config.nominal.fit:
            return self.base
        return with_estimates(self.base, self.estimates(left_out))

    def harmful(self, left_out: LeftOut = ALL) -> dict[str, str]:
        """A line for each axis on which the base vehicle's constants are kept."""
        lines: dict[str, str] = {}
        folds = self.split.inner(left_out)
        if len(folds) < 2 or not self.config.nominal.fit or self.model == "racing":
            return lines
        for fold in folds:
            part = self.samples()[self.split.fold == fold]
            fitted, kept = (
                np.sqrt((nominal_error(part, constants) ** 2).mean(axis=0))
                for constants in (self._fitted(left_out | {fold}), self.base)
            )
            changes = fitted / np.maximum(kept, 1e-300) - 1.0
            for axis, change in zip(AXES, changes, strict=True):
                if change > self.config.residual.max_harm:
                    lines[axis] = (
                        f"{axis}: the base vehicle's constants are kept: those fitted without "
                        f"{self.split.names[fold]} have a {100.0 * change:.0f}% larger error on it"
                    )
        return lines

    def constants(self, left_out: LeftOut = ALL) -> Constants:
        """The constants fitted without some folds."""
        of_axis, base = EQUATIONS[type(self.base)].constants, values_of(self.base)
        names = [name for axis in self.harmful(left_out) for name in of_axis[axis]]
        return replaced(self._fitted(left_out), {name: base[name] for name in names})

    def lags(self) -> tuple[list[Estimate], BatteryFit | None]:
        """The motors' lag with the battery's limit, and the rate-and-thrust model."""
        rows, constants = self.masks(), self.constants()
        if not isinstance(constants, MotorConstants):
            return [], None
        hover = float(np.sqrt(constants.g / (4.0 * constants.k_w)))
        base = BatteryConfig().filled(float(constants.rpm_max))
        lag, limit = fit_battery(self.logs, hover, base, rows, float(constants.tau))
        if "rate" not in self.vehicle.models:
            return [lag], limit
        rate: Any = self.vehicle.constants("rate")
        return [lag, *fit_rate_model(self.logs, rows, rate)], limit

    def fitted_vehicle(self, lags: Sequence[Estimate]) -> VehicleFile:
        """The base vehicle with fitted constants; its ``fitted_speed`` is that of the flights."""
        vehicle = self.vehicle.with_constants(self.model, self.constants())
        for estimate in lags:
            of = "rate" if estimate.group == "rate" else "motor"
            names = vehicle.models[of]
            constants = {name: x for name, x in estimate.constants.items() if name in names}
            vehicle = vehicle.with_constants(of, names | constants)
        if vehicle.fitted_speed is None:
            return vehicle
        tests = self.config.split.test_flights
        fitted = [log for log in self.logs if log.name not in tests]
        return replace(vehicle, fitted_speed=highest_speed(fitted))


def check_speeds(config: FitConfig, logs: Sequence[Flight], model: str) -> None:
    """Refuse logs that lack what the model needs, or are of another drone.

    Raises:
        InputError: a log without speeds, or faster than the config's range by more than the allowed
            scale error.
    """
    for log in logs:
        path, measured = log.source["path"], "actuators" in log.signals
        if model == "motor" and not measured:
            raise InputError(
                f"{path}: no columns for rpm (logs.columns.rpm), which the model motor needs; "
                "motor commands suffice for a racing quadcopter (vehicle=5inch.yaml)"
            )
        if config.body.rpm_range is None or not measured:
            continue
        (low, high), fastest = config.body.rpm_range, float(np.percentile(log["actuators"], 99.0))
        if fastest > high * (1.0 + config.logs.max_scale_error):
            raise InputError(
                f"{path}: speeds of up to {fastest:.5g} rpm, those of the vehicle are {low:g} to "
                f"{high:g} (body.rpm_range); is it this drone? is logs.units.rpm right?"
            )


def _warnings(
    config: FitConfig, logs: Sequence[Flight], estimates: Sequence[Estimate]
) -> Iterator[str]:
    for estimate in estimates:
        yield from estimate.warnings
    scaled = any({"command", "motor_command"} & set(log.signals) for log in logs)
    if config.body.rpm_range is None and not scaled:
        yield (
            "the common scale of the propeller speeds is not checked: the logs have no commanded "
            "speeds; body.rpm_range, if given, bounds it"
        )
    for log in logs:
        if row := log.source["cut_row"]:
            yield (f"{log.name}: row {row} is left out: no line break ends it, so it may be cut")
        if names := ", ".join(log.source["unchecked"]):
            yield (
                f"{log.name}: not checked for lack of motion or of columns to compare with: {names}"
            )
