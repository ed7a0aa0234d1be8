"""Report of a fit: tables and files."""

import json
from pathlib import Path

import numpy as np

from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.nominal import AXES, UNITS
from quadjax.fitting.pipeline import FitResult
from quadjax.fitting.prediction import Prediction, pooled
from quadjax.fitting.residual_fit import ALL
from quadjax.fitting.split import TEST
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import write_residual
from quadjax.vehicle.vehicle_file import write_vehicle

RESIDUAL_AXES = AXES[2:]
FILES = ("config.yaml", "vehicle.yaml", "residual.npz", "report.json", "report.txt")
FIGURES = ("held_out_*.png", "training_*.png", "errors.png")  # see ``figures.write_figures``
NONE_HELD_OUT = "held out: none (split.leave_one_out is off, split.test_flights is empty)"
PATTERNS = (*FILES, *FIGURES)  # of all files that a fit writes


def tables(result: FitResult) -> str:
    """The report as text."""
    parts = [_nominal_table(result), _change_table("training", result.training)]
    if result.held_out:
        parts += [_change_table("held out", pooled(result.held_out)), _by_flight(result.held_out)]
        if result.harmful and (result.split.fold == TEST).any():
            axes = ", ".join(result.harmful)
            parts.append(
                f"the base vehicle's constants of {axes} were chosen on the test rows, too"
            )
        if (result.gains < 1.0).any():
            written = [part.scaled(result.gains) for part in result.unlimited]
            parts.append(
                _by_flight(written, ", scaled as written: by factors chosen on these flights")
            )
    else:
        parts.append(NONE_HELD_OUT)
    if result.fits[ALL].choices:
        parts.append(_choices(result))
    return "\n\n".join(parts) + "\n"


def write_results(result: FitResult, folder: Path) -> list[Path]:
    """Write config, vehicle, residual and report to a folder; return the paths."""
    config, vehicle, residual, numbers, text = paths = [folder / name for name in FILES]
    tested, fit = result.config.split.test_flights, result.fits[ALL]
    write_text(config, to_yaml(result.config.model_dump()))
    fitted = [log.name for log in result.logs if log.name not in tested]
    source = f"Fitted on {', '.join(fitted)}\nby quadjax fit; see report.txt in this folder."
    write_vehicle(vehicle, result.vehicle, source, {"motor": {}, **_notes(result)})
    fitted_on = {
        "fit": result.config.name,
        "flights": fitted,
        "rejected": {axis: c.rejected for axis, c in fit.choices.items() if c.rejected},
        "constants": {
            name: float(getattr(fit.constants, name)) for name in constant_names(MotorConstants)
        },
    }
    write_residual(residual, fit.residual, fitted_on)
    write_json(numbers, as_json(result) | {"provenance": provenance(result.config)})
    write_text(text, tables(result))
    return paths


def _fitted(result: FitResult) -> list[tuple[str, str, float, float]]:
    """Name, axis, value and standard error of every constant."""
    rows = [
        (name, fit.axis, float(value), float(error))
        for fit in result.axes
        for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True)
    ]
    return [*rows, ("tau", "", result.lag.tau, result.lag.standard_error)]


def _fitted_rate(result: FitResult) -> list[tuple[str, float, float, float]]:
    """Name, value, standard error and R^2 of the constants of the rate-and-thrust model."""
    fit = result.rate
    if fit is None:
        return []
    return [
        (name, value, fit.standard_errors[name], fit.r_squared[name])
        for name, value in fit.values.items()
    ]


def as_json(result: FitResult) -> dict[str, object]:
    """The numbers of the report; null for those that are not finite."""
    report = {
        "flights": [log.name for log in result.logs],
        "constants": {
            name: {"value": value, "standard_error": error, "axis": axis}
            for name, axis, value, error in _fitted(result)
        },
        "axes": {
            fit.axis: {name: getattr(fit, name) for name in ("r_squared", "rmse", "condition")}
            for fit in result.axes
        },
        "rate_model": {
            name: {"value": value, "standard_error": error, "r_squared": r2}
            for name, value, error, r2 in _fitted_rate(result)
        },
        "warnings": result.warnings,
        "split": {"by": result.split.by, "folds": list(result.split.names)},
        "training": _prediction_json(result.training),
        "held_out": {part.name: _prediction_json(part) for part in result.held_out},
        "held_out_unlimited": {part.name: _prediction_json(part) for part in result.unlimited},
        "gains": dict(zip(RESIDUAL_AXES, result.gains.tolist(), strict=True)),
        "not_checked": {log.name: list(log.unchecked) for log in result.logs},
        "held_out_pooled": _prediction_json(pooled(result.held_out)) if result.held_out else None,
        "choices": {
            "final" if not left_out else result.split.names[min(left_out)]: {
                axis: vars(choice) | {"distilled": fit.distilled[axis]}
                for axis, choice in fit.choices.items()
            }
            for left_out, fit in result.fits.items()
        },
    }
    return json.loads(json.dumps(report), parse_constant=lambda _: None)


def _prediction_json(part: Prediction) -> dict[str, dict[str, float]]:
    columns = {
        "rmse_nominal": part.rmse(part.nominal),
        "rmse_residual": part.rmse(part.full),
        "change": part.change,
        "r_squared_nominal": r_squared(part.measured, part.nominal),
        "r_squared_residual": r_squared(part.measured, part.full),
    }
    return {axis: {k: float(v[i]) for k, v in columns.items()} for i, axis in enumerate(AXES)}


def _notes(result: FitResult) -> dict[str, dict[str, str]]:
    """A comment for every fitted constant of the vehicle file, by model."""
    if not result.config.nominal.fit:
        return {}
    fitted = {"", *result.config.nominal.axes} - set(result.harmful)  # tau has no axis
    motor = {
        name: f"+- {error:.2g}" if axis in fitted and np.isfinite(error) else "the base vehicle's"
        for name, axis, _, error in _fitted(result)
    }
    rate = {name: f"+- {error:.2g}" for name, _, error, _ in _fitted_rate(result)}
    return {"motor": motor, "rate": rate}


def _nominal_table(result: FitResult) -> str:
    lines = [
        "nominal model" if result.config.nominal.fit else "nominal model, if it were fitted",
        f"{'axis':5}{'constant':>10}{'value':>14}{'std. error':>12}{'rel.':>8}"
        f"{'condition':>11}{'R^2':>8}",
    ]
    quality = {fit.names[0]: (fit.condition, fit.r_squared) for fit in result.axes}
    for name, axis, value, error in _fitted(result):
        condition, r2 = quality.get(name, (None, None))
        tail = "" if condition is None else f"{condition:11.3g}{r2:8.3f}"
        if name == "tau":
            tail = f"{'':11}{result.lag.r_squared:8.3f}"
        relative = _percent(100.0 * error / max(abs(value), 1e-300))
        shown = axis if name in quality else ""
        lines.append(f"{shown:5}{name:>10}{value:14.5g}{error:12.2g}{relative:>8}{tail}")
    if rate := _fitted_rate(result):
        lines.append("rate-and-thrust model")
    for name, value, error, r2 in rate:
        relative = _percent(100.0 * error / max(abs(value), 1e-300))
        lines.append(f"{'':5}{name:>10}{value:14.5g}{error:12.2g}{relative:>8}{'':11}{r2:8.3f}")
    return "\n".join(lines + [f"warning: {line}" for line in result.warnings])


def _spread(value: float) -> str:
    return f"{100 * value:.1f}%" if np.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{value:.2g}%" if value < 99.5 else (">99%" if np.isfinite(value) else "-")


def _change_table(title: str, part: Prediction) -> str:
    before, after = part.rmse(part.nominal), part.rmse(part.full)
    fit_before = r_squared(part.measured, part.nominal)
    fit_after = r_squared(part.measured, part.full)
    lines = [
        f"{title}: nominal -> nominal plus residual ({len(part.rows)} samples)",
        f"{'axis':5}{'RMSE':>10}{'':4}{'RMSE':>8}{'change':>9}{'R^2':>9}{'':4}{'R^2':>5}",
    ]
    for i, axis in enumerate(AXES):
        lines.append(
            f"{axis:5}{before[i]:10.4g} -> {after[i]:8.4g}{100 * part.change[i]:+8.1f}%"
            f"{fit_before[i]:9.3f} -> {fit_after[i]:5.3f}  {UNITS[axis]}"
        )
    return "\n".join(lines)


def _by_flight(held_out: list[Prediction], title: str = "") -> str:
    width = max(len("worst"), *(len(part.name) for part in held_out)) + 2
    lines = [
        f"held out, by flight{title}: change of RMSE",
        " " * width + "".join(f"{axis:>9}" for axis in RESIDUAL_AXES),
    ]
    rows = [(part.name, part.change[2:]) for part in held_out]
    changes = [change for _, change in rows]
    rows += [("mean", np.mean(changes, axis=0)), ("worst", np.max(changes, axis=0))]
    for name, change in rows:
        lines.append(f"{name:{width}}" + "".join(f"{100 * c:+8.1f}%" for c in change))
    return "\n".join(lines)


def _choices(result: FitResult) -> str:
    fit = result.fits[ALL]
    lines = [
        "the written residual, selected on held-out folds",
        f"{'axis':5}{'mirror':>8}{'epochs':>8}{'scale':>7}{'gain':>8}{'+- seeds':>10}"
        f"{'agreement':>11}{'distilled':>11}  per fold",
    ]
    for axis, c in fit.choices.items():
        gains = " ".join(f"{100 * gain:+.1f}%" for gain in c.gains)
        lines.append(
            f"{axis:5}{'yes' if c.mirror else 'no':>8}{c.epoch + 1:8d}{c.scale:7.2f}"
            f"{100 * c.gain:7.1f}%{_spread(c.seed_spread):>10}{c.agreement:11.2f}"
            f"{fit.distilled[axis]:11.3f}  {gains}"
        )
    lines += [
        "agreement: mean square of the ensemble's mean over that of its networks, 1 is the same",
        "distilled: R^2 of the written network to the ensemble",
    ]
    if result.config.residual.seeds == 1:
        lines.append("residual.seeds is 1: gains are not compared with the spread between seeds")
    for axis, c in fit.choices.items():
        if c.rejected:
            lines.append(f"rejected: {axis}: {c.rejected}; written as zero")
    return "\n".join(lines)
