"""What a fit prints and writes: tables before and after, choices, warnings."""

import json
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from quadjax.core.files import write_json, write_text
from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.nominal import AXES, UNITS
from quadjax.fitting.pipeline import FitResult, Judged, changes, pooled
from quadjax.fitting.residual_fit import ALL
from quadjax.fitting.vehicle_file import write_vehicle
from quadjax.vehicle.constants import MotorConstants, constant_names
from quadjax.vehicle.residual_file import write_residual

RESIDUAL_AXES = AXES[2:]


def tables(result: FitResult) -> str:
    """The whole report as text."""
    parts = [
        _nominal_table(result),
        _before_after("training", result.training),
    ]
    if result.held_out:
        parts += [_before_after("held out", pooled(result.held_out)), _by_flight(result.held_out)]
    else:
        parts.append(f"held out: nothing, because {result.no_held_out}")
    if result.fits[ALL].choices:
        parts.append(_choices(result))
    return "\n\n".join(parts) + "\n"


def warnings(result: FitResult) -> list[str]:
    """Every warning about the constants."""
    found = [line for axis in result.axes for line in axis.warnings]
    return found + ([result.lag.warning] if result.lag.warning else [])


def write_results(result: FitResult, folder: Path) -> list[Path]:
    """Write config, vehicle, residual and report to a folder; what was written."""
    config = OmegaConf.to_yaml(OmegaConf.structured(result.config))
    write_text(folder / "config.yaml", config)
    flights = ", ".join(log.name for log in result.logs)
    source = f"Fitted on {flights}\nby quadjax (quadjax fit); see report.txt beside this file."
    write_vehicle(folder / "vehicle.yaml", result.vehicle, _notes(result), source)
    fitted_on = {
        "fit": result.config.name,
        "flights": [log.name for log in result.logs],
        "refused": {a: c.refused for a, c in result.fits[ALL].choices.items() if c.refused},
        "constants": {
            name: float(getattr(result.fits[ALL].constants, name))
            for name in constant_names(MotorConstants)
        },
    }
    write_residual(folder / "residual.npz", result.fits[ALL].residual, fitted_on)
    write_json(folder / "report.json", as_json(result))
    write_text(folder / "report.txt", tables(result))
    names = ("config.yaml", "vehicle.yaml", "residual.npz", "report.json", "report.txt")
    return [folder / name for name in names]


def as_json(result: FitResult) -> dict[str, object]:
    """Every number of the report."""
    fits = {
        "final" if not left_out else result.split.names[min(left_out)]: {
            axis: choice.__dict__ | {"taught": fit.taught[axis]}
            for axis, choice in fit.choices.items()
        }
        for left_out, fit in result.fits.items()
    }
    report = {
        "constants": {
            name: {"value": value, "standard_error": error, "axis": axis.axis}
            for axis in result.axes
            for name, value, error in zip(
                axis.names, axis.values, axis.standard_errors, strict=True
            )
        }
        | {"tau": {"value": result.lag.tau, "standard_error": result.lag.standard_error}},
        "axes": {
            axis.axis: {
                "r_squared": axis.r_squared,
                "rmse": axis.rmse,
                "condition": axis.condition,
            }
            for axis in result.axes
        },
        "warnings": warnings(result),
        "split": {"by": result.split.by, "folds": list(result.split.names)},
        "training": _judged_json(result.training),
        "held_out": {judged.name: _judged_json(judged) for judged in result.held_out},
        "held_out_pooled": _judged_json(pooled(result.held_out)) if result.held_out else None,
        "choices": fits,
    }
    return json.loads(json.dumps(report, default=_plain), parse_constant=lambda _: None)


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def _judged_json(judged: Judged) -> dict[str, dict[str, float]]:
    return {
        axis: {
            "rmse_nominal": float(judged.rmse(judged.nominal)[i]),
            "rmse_residual": float(judged.rmse(judged.full)[i]),
            "change": float(changes(judged)[i]),
            "r_squared_nominal": float(r_squared(judged.measured, judged.nominal)[i]),
            "r_squared_residual": float(r_squared(judged.measured, judged.full)[i]),
        }
        for i, axis in enumerate(AXES)
    }


def _notes(result: FitResult) -> dict[str, str]:
    if not result.config.nominal.fit:
        return {}
    notes = {}
    for axis in result.axes:
        for name, error in zip(axis.names, axis.standard_errors, strict=True):
            notes[name] = f"+- {error:.2g}" if np.isfinite(error) else "not excited: the base's"
    if np.isfinite(result.lag.standard_error):
        notes["tau"] = f"+- {result.lag.standard_error:.2g}"
    else:
        notes["tau"] = "not excited: the base's"
    return notes


def _nominal_table(result: FitResult) -> str:
    head = "nominal model" if result.config.nominal.fit else "nominal model, if it were fitted"
    lines = [
        head,
        f"{'axis':5}{'constant':>10}{'value':>14}{'std. error':>12}{'rel.':>8}"
        f"{'condition':>11}{'R^2':>8}",
    ]
    for axis in result.axes:
        for i, name in enumerate(axis.names):
            value, error = axis.values[i], axis.standard_errors[i]
            relative = 100.0 * error / max(abs(value), 1e-300)
            tail = f"{axis.condition:11.3g}{axis.r_squared:8.3f}" if i == 0 else ""
            lines.append(
                f"{axis.axis if i == 0 else '':5}{name:>10}{value:14.5g}{error:12.2g}"
                f"{_percent(relative):>8}{tail}"
            )
    lag = result.lag
    relative = 100.0 * lag.standard_error / lag.tau
    lines.append(
        f"{'':5}{'tau':>10}{lag.tau:14.5g}{lag.standard_error:12.2g}{_percent(relative):>8}"
        f"{'':11}{lag.r_squared:8.3f}"
    )
    lines += [f"warning: {line}" for line in warnings(result)]
    return "\n".join(lines)


def _percent(value: float) -> str:
    return f"{value:.2g}%" if value < 99.5 else (">99%" if np.isfinite(value) else "-")


def _before_after(title: str, judged: Judged) -> str:
    before, after = judged.rmse(judged.nominal), judged.rmse(judged.full)
    fit_before = r_squared(judged.measured, judged.nominal)
    fit_after = r_squared(judged.measured, judged.full)
    lines = [
        f"{title}: nominal -> nominal plus residual ({len(judged.rows)} samples)",
        f"{'axis':5}{'RMSE':>10}{'':4}{'RMSE':>8}{'change':>9}{'R^2':>9}{'':4}{'R^2':>5}",
    ]
    for i, axis in enumerate(AXES):
        lines.append(
            f"{axis:5}{before[i]:10.4g} -> {after[i]:8.4g}{100 * changes(judged)[i]:+8.1f}%"
            f"{fit_before[i]:9.3f} -> {fit_after[i]:5.3f}  {UNITS[axis]}"
        )
    return "\n".join(lines)


def _by_flight(held_out: list[Judged]) -> str:
    width = max(len(judged.name) for judged in held_out) + 2
    lines = [
        "held out, one by one: change of RMSE",
        " " * width + "".join(f"{axis:>9}" for axis in RESIDUAL_AXES),
    ]
    rows = [(judged.name, changes(judged)[2:]) for judged in held_out]
    rows.append(("mean", np.mean([change for _, change in rows], axis=0)))
    for name, change in rows:
        lines.append(f"{name:{width}}" + "".join(f"{100 * c:+8.1f}%" for c in change))
    return "\n".join(lines)


def _choices(result: FitResult) -> str:
    fit = result.fits[ALL]
    lines = [
        "the residual that is written, as chosen on held-out folds",
        f"{'axis':5}{'mirror':>8}{'epochs':>8}{'scale':>7}{'gain':>8}{'+- seeds':>10}"
        f"{'agreement':>11}{'taught':>8}  per fold",
    ]
    for axis, c in fit.choices.items():
        gains = " ".join(f"{100 * gain:+.1f}%" for gain in c.gains)
        lines.append(
            f"{axis:5}{'yes' if c.mirror else 'no':>8}{c.epoch + 1:8d}{c.scale:7.2f}"
            f"{100 * c.gain:7.1f}%{100 * c.seed_spread:9.1f}%{c.agreement:11.2f}"
            f"{fit.taught[axis]:8.3f}  {gains}"
        )
    for axis, c in fit.choices.items():
        if c.refused:
            lines.append(f"refused: {axis}: {c.refused}; written as zero")
    return "\n".join(lines)
