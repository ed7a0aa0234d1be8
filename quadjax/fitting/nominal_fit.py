"""The constants of a model, fitted to some folds of the rows of flights."""

from collections.abc import Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np

from quadjax.fitting.axes import fit_axes, fit_shared_constants, nominal_error, with_estimates
from quadjax.fitting.config import FitConfig, check_keys
from quadjax.fitting.flight_log import highest_speed
from quadjax.fitting.lags import BETWEEN
from quadjax.fitting.motors import (
    MAP,
    BatteryFit,
    fit_battery,
    fit_motors,
    fit_rate_model,
    with_simulated_speeds,
)
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants
from quadjax.fitting.regression import Estimate
from quadjax.fitting.samples import Folds, Samples, airborne, make_split, prepare
from quadjax.flights.flight import Flight
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.vehicle_file import VehicleFile


class NominalFits:
    """The constants of a model, fitted to some folds; each fit is computed once.

    ``motor``: an axis keeps the base vehicle's constants if those fitted without a fold increase
    its error by more than ``residual.max_harm``. ``racing``: motors are fitted first; their
    simulated speeds are used where logs have none.
    """

    def __init__(
        self, config: FitConfig, logs: Sequence[Flight], vehicle: VehicleFile, model: str
    ) -> None:
        """Prepare the rows of flights; ``vehicle`` is the base vehicle of the model."""
        self.config, self.logs, self.vehicle, self.model = config, logs, vehicle, model
        self.rows = [airborne(log, config.logs.min_seconds) for log in logs]  # (n,) bool of each
        pairs = zip(logs, self.rows, strict=True)
        times = [log.time[used] - log.time[0] for log, used in pairs]
        self.split = make_split(times, [log.name for log in logs], config.split)
        check_keys(config, model, self.split.by)
        self.base: Any = vehicle.constants(model)
        self._fits: dict[Folds, tuple[Samples, list[Estimate]]] = {}
        measured = all("actuators" in log.signals for log in logs)
        self._measured = prepare(logs, self.base, self.rows) if measured else None
        if model == "motor" and config.body.rpm_range is None:
            # The range of the flights, rounded outwards to hundreds.
            used = [
                self.samples(self.split.all).motion.rpm,
                *(log["command"] for log in logs if "command" in log.signals),
            ]
            low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
            high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
            self.base = self.base.replace(rpm_min=max(low, 0.0), rpm_max=high)
            self.vehicle = vehicle.with_constants(model, self.base)

    def samples(self, folds: Folds) -> Samples:
        """Every row; nothing in them is computed from other folds."""
        return self._fit(folds)[0]

    def estimates(self, folds: Folds) -> list[Estimate]:
        """The constants that are fitted to some folds, with their errors."""
        return self._fit(folds)[1]

    def _masks(self, folds: Folds) -> list[np.ndarray]:
        """The rows (n,) bool of each flight that are in flight and of some folds."""
        ends = np.cumsum([int(rows.sum()) for rows in self.rows])[:-1]
        masks = [rows.copy() for rows in self.rows]
        for mask, used in zip(masks, np.split(self.split.rows(folds), ends), strict=True):
            mask[mask] = used
        return masks

    def _fit(self, folds: Folds) -> tuple[Samples, list[Estimate]]:
        if folds in self._fits:
            return self._fits[folds]
        base, motors, logs = self.base, [], self.logs
        if self.model == "racing":
            motors = [fit_motors(logs, self._masks(folds), base)]
            of_motors = motors[0].constants
            values = np.array([of_motors[name] for name in MAP])
            between = of_motors.get(BETWEEN, 0.0)
            logs = [with_simulated_speeds(log, values, between) for log in logs]
        samples = self._measured
        if samples is None:
            samples = prepare(logs, base, self.rows)
        used = samples[self.split.rows(folds)]
        shared = fit_shared_constants(used) if self.model == "racing" else {}
        axes = fit_axes(used, replaced(base, shared), shared.keys())
        axes = [fit for fit in axes if fit.group in self.config.nominal.axes]
        self._fits[folds] = samples, [*axes, *motors]
        return self._fits[folds]

    def _fitted(self, folds: Folds) -> Constants:
        if not self.config.nominal.fit:
            return self.base
        return with_estimates(self.base, self.estimates(folds))

    def kept(self, folds: Folds) -> dict[str, str]:
        """A line for each axis on which the base vehicle's constants are kept."""
        lines: dict[str, str] = {}
        if len(folds) < 2 or not self.config.nominal.fit or self.model == "racing":
            return lines
        for fold in sorted(folds):
            part = self.samples(folds)[self.split.fold == fold]
            fitted, kept = (
                np.sqrt((nominal_error(part, constants) ** 2).mean(axis=0))
                for constants in (self._fitted(folds - {fold}), self.base)
            )
            changes = fitted / np.maximum(kept, 1e-300) - 1.0
            for axis, change in zip(AXES, changes, strict=True):
                if change > self.config.residual.max_harm:
                    lines[axis] = (
                        f"{axis}: the base vehicle's constants are kept: those fitted without "
                        f"{self.split.names[fold]} have a {100.0 * change:.0f}% larger error on it"
                    )
        return lines

    def constants(self, folds: Folds) -> Constants:
        """The constants fitted to some folds."""
        of_axis, base = EQUATIONS[type(self.base)].constants, values_of(self.base)
        names = [name for axis in self.kept(folds) for name in of_axis[axis]]
        return replaced(self._fitted(folds), {name: base[name] for name in names})

    def fitted_axes(self, folds: Folds) -> Set[str]:
        """The axes whose constants are those fitted to some folds."""
        if not self.config.nominal.fit:
            return frozenset()
        return frozenset(self.config.nominal.axes) - self.kept(folds).keys()

    def lags(self) -> tuple[list[Estimate], BatteryFit | None]:
        """The motors' lag with the battery's limit, and the rate-and-thrust model."""
        rows, constants = self._masks(self.split.all), self.constants(self.split.all)
        lags, limit, logs = list[Estimate](), None, self.logs
        if isinstance(constants, MotorConstants):
            hover = float(np.sqrt(constants.g / (4.0 * constants.k_w)))
            base = BatteryConfig().filled(float(constants.rpm_max))
            lag, limit = fit_battery(logs, hover, base, rows, float(constants.tau))
            lags.append(lag)
        if "rate" in self.vehicle.models:
            rate: Any = self.vehicle.constants("rate")
            lags += fit_rate_model(logs, rows, rate)
        return lags, limit

    def fitted_vehicle(self, lags: Sequence[Estimate]) -> VehicleFile:
        """The base vehicle with fitted constants; its ``fitted_speed`` is that of the flights."""
        if not self.config.nominal.fit:
            return self.vehicle
        vehicle = self.vehicle.with_constants(self.model, self.constants(self.split.all))
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
