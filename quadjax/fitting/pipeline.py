"""A complete fit: logs in, vehicle constants, residual networks and evaluation out."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.fitting.config import BodyConfig, FitConfig
from quadjax.fitting.flight_log import FlightLog, read_logs
from quadjax.fitting.least_squares import AxisFit, fit_nominal, with_fit
from quadjax.fitting.motor_lag import LagFit, fit_motor_lag
from quadjax.fitting.nominal import residual_output
from quadjax.fitting.prepare import Samples, airborne, prepare
from quadjax.fitting.residual_fit import (
    ALL,
    LeftOut,
    ResidualFit,
    fit_residuals,
    outer_sets,
    zero_residual,
)
from quadjax.fitting.split import TEST, Split, make_split
from quadjax.fitting.tasks import learned_rows, nominal_error, nominal_without
from quadjax.fitting.vehicle_file import BaseVehicle, read_vehicle, with_body

Report = Callable[[str], None]


@dataclass(frozen=True)
class Evaluation:
    """Errors of one model on some rows; columns as ``AXES``."""

    name: str  # of the rows
    rows: np.ndarray  # (n,) index into the samples
    measured: np.ndarray  # (n, 6)
    nominal: np.ndarray  # (n, 6)
    full: np.ndarray  # (n, 6) nominal plus residual

    def rmse(self, modeled: np.ndarray) -> np.ndarray:
        """Root mean square error (6,)."""
        return np.sqrt(((self.measured - modeled) ** 2).mean(axis=0))

    @property
    def change(self) -> np.ndarray:
        """Relative change (6,) of the root mean square error due to the residual."""
        return self.rmse(self.full) / np.maximum(self.rmse(self.nominal), 1e-300) - 1.0


@dataclass(frozen=True)
class FitResult:
    """Result of a fit."""

    config: FitConfig
    logs: list[FlightLog]
    samples: Samples
    split: Split
    vehicle: BaseVehicle  # fitted
    axes: list[AxisFit]
    lag: LagFit
    fits: dict[LeftOut, ResidualFit]
    training: Evaluation  # the final model on its own rows
    held_out: list[Evaluation]  # each by a model that has not seen these rows
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
    base = with_body(read_vehicle(config.vehicle, folder), config.body)
    report("reading the logs")
    logs = read_logs(config.logs, folder)
    flights = [log.name for log in logs]
    report("preparing the samples")
    samples = prepare(logs, base.motor, config.prepare, config.logs.min_seconds)
    base = _with_rpm_range(base, config.body, logs, samples)
    split = make_split(samples, flights, config.split)
    report("fitting the nominal model")
    axes = fit_nominal(samples[learned_rows(split.fold, ALL)], base.motor)
    known = [log for log in logs if log.name not in config.split.test_flights]
    lag = fit_motor_lag(
        known, [airborne(log, config.prepare) for log in known], float(base.motor.tau)
    )
    if config.nominal.fit:
        fitted = with_fit(base.motor, axes).replace(tau=lag.tau)
        vehicle = dataclasses.replace(base, motor=fitted)
    else:
        vehicle = base
    fits = _fit_residuals(config, samples, split, base, report)
    return FitResult(
        config=config,
        logs=logs,
        samples=samples,
        split=split,
        vehicle=vehicle,
        axes=axes,
        lag=lag,
        fits=fits,
        training=evaluate("training", samples, learned_rows(split.fold, ALL), fits[ALL]),
        held_out=_evaluate_held_out(samples, split, flights, fits),
        warnings=_warnings(config, axes, lag),
    )


def evaluate(name: str, samples: Samples, mask: np.ndarray, fit: ResidualFit) -> Evaluation:
    """Evaluate a model on the rows of a mask (n,) bool."""
    rows = np.flatnonzero(mask)
    part = samples[rows]
    nominal = part.measured - nominal_error(part, fit.constants)
    full = nominal.copy()
    full[:, 2:] += residual_output(fit.residual, part.motion)
    return Evaluation(name, rows, part.measured, nominal, full)


def pooled(evaluations: list[Evaluation]) -> Evaluation:
    """The rows of several evaluations."""
    columns = zip(*(list(vars(part).values())[1:] for part in evaluations), strict=True)
    return Evaluation("all", *map(np.concatenate, columns))


def _with_rpm_range(
    base: BaseVehicle, body: BodyConfig, logs: list[FlightLog], samples: Samples
) -> BaseVehicle:
    """The range of the flights, rounded outwards to hundreds, unless the config has one."""
    if body.rpm_range is not None:
        return base
    used = [samples.motion.rpm] + [log.rpm_command for log in logs if log.rpm_command is not None]
    low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
    high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
    motor = base.motor.replace(rpm_min=max(low, 0.0), rpm_max=high)
    return dataclasses.replace(base, motor=motor)


def _fit_residuals(
    config: FitConfig, samples: Samples, split: Split, base: BaseVehicle, report: Report
) -> dict[LeftOut, ResidualFit]:
    leave_one_out = config.split.leave_one_out and split.by == "flight" and split.folds > 1
    fit = config.nominal.fit
    if config.residual.fit:
        return fit_residuals(
            samples, split, base.motor, config.residual, config.seed, leave_one_out, fit, report
        )
    zero = zero_residual(base.motor)
    return {
        s: ResidualFit(nominal_without(samples, split.fold, s, base.motor, fit), zero, {}, {})
        for s in outer_sets(split, leave_one_out)
    }


def _evaluate_held_out(
    samples: Samples, split: Split, flights: list[str], fits: dict[LeftOut, ResidualFit]
) -> list[Evaluation]:
    found = []
    for number, name in enumerate(split.names):
        fit = fits.get(frozenset({number}))
        if fit is not None:
            found.append(evaluate(name, samples, split.fold == number, fit))
    for index, name in enumerate(flights):
        rows = (split.fold == TEST) & (samples.flight == index)
        if rows.any():
            label = name if split.by == "flight" else f"{name}, last part"
            found.append(evaluate(label, samples, rows, fits[ALL]))
    return found


def _warnings(config: FitConfig, axes: list[AxisFit], lag: LagFit) -> list[str]:
    lines = [line for axis in axes for line in axis.warnings]
    lines += [lag.warning] if lag.warning else []
    if config.body.inertia is None:
        lines.append(
            f"body.inertia is not set: the inertia of {config.vehicle} is used, to which all "
            "moments are proportional"
        )
    return lines
