"""Report of a fit of the model ``racing``: tables and files."""

import json
from pathlib import Path

import numpy as np

from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.fitting.motor_map import NAMES
from quadjax.fitting.nominal import AXES, EQUATIONS
from quadjax.fitting.racing_fit import MODEL, RacingFit
from quadjax.fitting.report import NONE_HELD_OUT
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.vehicle_file import write_vehicle

FILES = ("config.yaml", "vehicle.yaml", "report.json", "report.txt")


def racing_tables(result: RacingFit) -> str:
    """The report as text."""
    lines = [
        f"model {MODEL} (it has no residual network)",
        f"{'axis':6}{'constant':>9}{'value':>13}{'std. error':>12}{'rel.':>8}{'R^2':>8}",
    ]
    shown: set[str] = set()
    for name, axis, value, error in _constants(result):
        relative = f"{100.0 * error / max(abs(value), 1e-300):.2g}%" if np.isfinite(error) else "-"
        quality = "" if axis in shown else f"{_r_squared(result, axis):8.4f}"
        head = "" if axis in shown else axis
        lines.append(f"{head:6}{name:>9}{value:13.5g}{error:12.2g}{relative:>8}{quality}")
        shown.add(axis)
    lines += [f"warning: {line}" for line in result.warnings]
    if not result.held_out:
        return "\n".join([*lines, "", NONE_HELD_OUT]) + "\n"
    width = max(len(part.name) for part in result.held_out) + 2
    what = "last part of each flight" if result.by == "time" else "flight"
    lines += [
        "",
        f"held out: R^2 of each {what} by a fit without it",
        " " * width + _row(AXES, ">8"),
    ]
    lines += [f"{part.name:{width}}{_row(part.r_squared, '8.3f')}" for part in result.held_out]
    return "\n".join(lines) + "\n"


def write_racing_results(result: RacingFit, folder: Path) -> list[Path]:
    """Write config, vehicle and report to a folder; return the paths."""
    config, vehicle, numbers, text = paths = [folder / name for name in FILES]
    write_text(config, to_yaml(result.config.model_dump()))
    _write_vehicle(vehicle, result)
    write_json(numbers, racing_json(result) | {"provenance": provenance(result.config)})
    write_text(text, racing_tables(result))
    return paths


def racing_json(result: RacingFit) -> dict[str, object]:
    """The numbers of the report; null for those that are not finite."""
    report = {
        "model": MODEL,
        "flights": [log.name for log in result.logs],
        "constants": {
            name: {"value": value, "standard_error": error, "axis": axis}
            for name, axis, value, error in _constants(result)
        },
        "axes": {fit.axis: {"r_squared": fit.r_squared, "rmse": fit.rmse} for fit in result.axes},
        "motors": {"r_squared": result.motors.r_squared},
        "warnings": result.warnings,
        "held_out": {
            part.name: {
                axis: {"rmse": float(part.rmse[i]), "r_squared": float(part.r_squared[i])}
                for i, axis in enumerate(AXES)
            }
            for part in result.held_out
        },
        "not_checked": {log.name: list(log.unchecked) for log in result.logs},
    }
    return json.loads(json.dumps(report), parse_constant=lambda _: None)


def _row(values: object, form: str) -> str:
    return "".join(f"{value:{form}}" for value in values)


def _constants(result: RacingFit) -> list[tuple[str, str, float, float]]:
    """Name, axis, value and standard error of every constant."""
    rows = [
        (name, fit.axis, float(value), float(error))
        for fit in result.axes
        for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True)
    ]
    motors = zip(NAMES, result.motors.values, result.motors.standard_errors, strict=True)
    return rows + [(name, "motors", float(value), float(error)) for name, value, error in motors]


def _r_squared(result: RacingFit, axis: str) -> float:
    found = {fit.axis: fit.r_squared for fit in result.axes}
    return found.get(axis, result.motors.r_squared)


def _note(error: float) -> str:
    return f"+- {error:.2g}" if np.isfinite(error) else "not determined by the logs"


def _write_vehicle(path: Path, result: RacingFit) -> None:
    linear = EQUATIONS[RacingConstants].constants.values()
    notes = dict.fromkeys((name for names in linear for name in names), "the base vehicle's")
    notes |= {name: _note(error) for name, _, _, error in _constants(result)}
    tested = result.config.split.test_flights
    flights = ", ".join(log.name for log in result.logs if log.name not in tested)
    source = f"Fitted on {flights}\nby quadjax fit; see report.txt in this folder."
    write_vehicle(path, result.vehicle, source, {MODEL: notes})
