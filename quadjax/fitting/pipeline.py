"""One fit from beginning to end: logs in, vehicle file, residual file and report out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.config.loading import fill, merge_trees, parse_words, read_yaml_with_base
from quadjax.core.errors import InputError
from quadjax.fitting.config import BodyConfig, FitConfig
from quadjax.fitting.estimator_reference import residual_output
from quadjax.fitting.flight_log import FlightLog, read_logs
from quadjax.fitting.least_squares import AxisFit, fit_nominal, with_fit
from quadjax.fitting.motor_lag import LagFit, fit_motor_lag
from quadjax.fitting.nominal import AXES
from quadjax.fitting.prepare import Samples, airborne, prepare
from quadjax.fitting.problem import learned_rows, nominal_error, nominal_without
from quadjax.fitting.residual_fit import (
    ALL,
    LeftOut,
    ResidualFit,
    check_residual_config,
    fit_residuals,
    zero_residual,
)
from quadjax.fitting.split import TEST, Split, make_split
from quadjax.fitting.vehicle_file import BaseVehicle, read_vehicle, with_body


@dataclass(frozen=True)
class Judged:
    """Errors of one model on some rows; as ``AXES``."""

    name: str  # of the rows
    rows: np.ndarray  # (n,) index into the samples
    measured: np.ndarray  # (n, 6)
    nominal: np.ndarray  # (n, 6)
    full: np.ndarray  # (n, 6) nominal plus residual

    def rmse(self, modelled: np.ndarray) -> np.ndarray:
        """Root mean square error (6,)."""
        return np.sqrt(((self.measured - modelled) ** 2).mean(axis=0))


@dataclass(frozen=True)
class FitResult:
    """Everything that a fit has found."""

    config: FitConfig
    logs: list[FlightLog]
    samples: Samples
    split: Split
    vehicle: BaseVehicle  # fitted
    axes: list[AxisFit]
    lag: LagFit
    fits: dict[LeftOut, ResidualFit]
    training: Judged  # the final model on what it was fitted to
    held_out: list[Judged]  # each by a model that these rows had no say in
    no_held_out: str | None  # why there are none


def load_fit_config(path: Path | str, words: Sequence[str] = ()) -> FitConfig:
    """The config of a YAML file and ``key=value`` words.

    Raises:
        InputError: an unknown key, a wrong type or an unreadable file.
    """
    tree = merge_trees(read_yaml_with_base(path), parse_words(words))
    config = fill(FitConfig, tree, str(path))
    if not config.name or any(letter in config.name for letter in "/\\") or config.name == "..":
        raise InputError(f"name is {config.name!r}, expected the name of a folder in {config.runs}")
    if config.seed < 0:
        raise InputError(f"seed is {config.seed}, expected at least 0")
    check_residual_config(config.residual)
    return config


def run_fit(
    config: FitConfig, beside: Path, report: Callable[[str], None] = lambda line: None
) -> FitResult:
    """Fit the nominal model and the residual networks.

    Args:
        config: what to fit.
        beside: the config file's folder, where files that it names are looked for as well.
        report: told what is being done.

    Raises:
        InputError: bad logs or a bad config, in one line.
    """
    base = with_body(read_vehicle(config.vehicle, beside), config.body)
    report("reading the logs")
    logs = _read(config, beside)
    report("preparing the samples")
    samples = prepare(logs, base.motor, config.prepare, config.logs.min_seconds)
    base = _with_rpm_range(base, config.body, logs, samples)
    split = make_split(samples, [log.name for log in logs], config.split)
    report("fitting the nominal model")
    learned = samples[learned_rows(split.fold, ALL)]
    axes = fit_nominal(learned, base.motor)
    known = [log for log in logs if log.name not in config.split.test_flights]
    lag = fit_motor_lag(known, [airborne(log, config.prepare) for log in known], base.motor.tau)
    constants = base.motor
    if config.nominal.fit:
        constants = with_fit(base.motor, axes).replace(tau=lag.tau)
    fits = _fit_residuals(config, samples, split, base, report)
    held_out, reason = _judge_held_out(config, samples, split, [log.name for log in logs], fits)
    return FitResult(
        config=config,
        logs=logs,
        samples=samples,
        split=split,
        vehicle=BaseVehicle(base.name, base.mass, constants, base.rate),
        axes=axes,
        lag=lag,
        fits=fits,
        training=judge("training", samples, learned_rows(split.fold, ALL), fits[ALL]),
        held_out=held_out,
        no_held_out=reason,
    )


def judge(name: str, samples: Samples, mask: np.ndarray, fit: ResidualFit) -> Judged:
    """Hold a model against the rows of a mask (n,) bool."""
    rows = np.flatnonzero(mask)
    part = samples[rows]
    nominal = part.measured - nominal_error(part, fit.constants)
    force, moment = residual_output(fit.residual, part.motion)
    extra = np.concatenate([np.zeros((len(rows), 2)), force[:, None], moment], axis=1)
    return Judged(name, rows, part.measured, nominal, nominal + extra)


def _read(config: FitConfig, beside: Path) -> list[FlightLog]:
    """Paths are relative to where the command runs, or else to the config's folder."""
    try:
        return read_logs(config.logs, Path())
    except InputError as error:
        if "no such file (logs.files)" not in str(error):
            raise
        return read_logs(config.logs, beside)


def _with_rpm_range(
    base: BaseVehicle, body: BodyConfig, logs: list[FlightLog], samples: Samples
) -> BaseVehicle:
    """The range that the flights have used, rounded outwards to hundreds, if none is given."""
    if body.rpm_range is not None:
        return base
    used = [samples.motion.rpm] + [log.rpm_command for log in logs if log.rpm_command is not None]
    low = 100.0 * np.floor(min(float(part.min()) for part in used) / 100.0)
    high = 100.0 * np.ceil(max(float(part.max()) for part in used) / 100.0)
    motor = base.motor.replace(rpm_min=max(low, 0.0), rpm_max=high)
    return BaseVehicle(base.name, base.mass, motor, base.rate)


def _fit_residuals(
    config: FitConfig,
    samples: Samples,
    split: Split,
    base: BaseVehicle,
    report: Callable[[str], None],
) -> dict[LeftOut, ResidualFit]:
    if config.residual.fit:
        return fit_residuals(
            samples,
            split,
            base.motor,
            config.residual,
            config.seed,
            config.split.leave_one_out and split.by == "flight" and split.folds > 1,
            config.nominal.fit,
            report,
        )
    zero, outer = zero_residual(base.motor), [ALL]
    if config.split.leave_one_out and split.by == "flight" and split.folds > 1:
        outer += [frozenset({fold}) for fold in range(split.folds)]
    fold, fit = split.fold, config.nominal.fit
    constants = [nominal_without(samples, fold, left_out, base.motor, fit) for left_out in outer]
    return {
        left_out: ResidualFit(found, zero, {}, {})
        for left_out, found in zip(outer, constants, strict=True)
    }


def _judge_held_out(
    config: FitConfig,
    samples: Samples,
    split: Split,
    flights: list[str],
    fits: dict[LeftOut, ResidualFit],
) -> tuple[list[Judged], str | None]:
    judged = []
    for number, name in enumerate(split.names):
        fit = fits.get(frozenset({number}))
        if fit is not None:
            judged.append(judge(name, samples, split.fold == number, fit))
    for index, name in enumerate(flights):
        rows = (split.fold == TEST) & (samples.flight == index)
        if rows.any():
            label = name if split.by == "flight" else f"{name}, last part"
            judged.append(judge(label, samples, rows, fits[ALL]))
    if judged:
        return judged, None
    return [], "split.leave_one_out is off and split.test_flights is empty"


def pooled(judged: list[Judged]) -> Judged:
    """Several judgements as one."""
    return Judged(
        "all",
        *(
            np.concatenate([getattr(part, name) for part in judged])
            for name in ("rows", "measured", "nominal", "full")
        ),
    )


def changes(judged: Judged) -> np.ndarray:
    """Relative change (6,) of the root mean square error that the residual brings; as ``AXES``."""
    before = judged.rmse(judged.nominal)
    return judged.rmse(judged.full) / np.maximum(before, 1e-300) - 1.0


def axis_index(axis: str) -> int:
    """Where an axis is among ``AXES``."""
    return AXES.index(axis)
