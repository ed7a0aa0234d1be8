"""Report of a fit: tables, files, and figures of signals against time and of errors."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from quadjax.core.files import write_json, write_text
from quadjax.core.markdown import render_lines
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.core.provenance import provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.fitting.axes import Prediction, pooled
from quadjax.fitting.fit import Fit, FittedModel
from quadjax.fitting.nominal import AXES, EQUATIONS
from quadjax.fitting.regression import Estimate, r_squared
from quadjax.fitting.residual import Choice
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.residual import write_residual
from quadjax.vehicle.vehicle_file import write_vehicle

RESIDUAL_AXES = AXES[2:]
FILES = ("config.yaml", "vehicle.yaml", "report.json", "report.txt")
RESIDUAL = "residual.npz"
FIGURES = ("held_out_*.png", "training_*.png", "errors.png")
PATTERNS = (*FILES, RESIDUAL, *FIGURES)  # of all files that a fit writes
COLUMNS = {  # of a prediction: title and format
    "rmse_nominal": ("RMSE", ".4g"),
    "rmse_residual": ("RMSE with residual", ".4g"),
    "change": ("change", "+.1%"),
    "r_squared_nominal": ("R^2", ".3f"),
    "r_squared_residual": ("R^2 with residual", ".3f"),
}
COLORS = {"nominal": SERIES[3], "residual": SERIES[0]}
LABELS = {"nominal": "nominal", "residual": "nominal + residual"}
POINTS = 1500  # of a line, at most


def tables(result: Fit) -> str:
    """The report as text."""
    what = "held out, each by a fit without it"
    parts = [_constants(result), _errors(result, "training", result.training)]
    parts += [_errors(result, what, pooled(result.held_out)), _by_flight(result)]
    if result.fitted.residual and result.fitted.residual.choices:
        parts.append(_choices(result, result.fitted.residual.choices))
    elif not result.fitted.residual:
        parts.append(f"the model {result.model} has no residual network")
    return "\n\n".join(parts) + "\n"


def write_results(result: Fit, folder: Path) -> list[Path]:
    """Write config, vehicle, report and, if the model has one, the residual; return the paths."""
    config, vehicle, numbers, text = paths = [folder / name for name in FILES]
    write_text(config, to_yaml(result.config.model_dump()))
    fitted = ", ".join(result.fitted_flights)
    source = f"Fitted on {fitted}\nby quadjax fit; see report.txt in this folder."
    write_vehicle(vehicle, result.vehicle, source, _notes(result))
    write_json(numbers, as_json(result) | {"provenance": provenance(result.config)})
    write_text(text, tables(result))
    if fit := result.fitted.residual:
        paths.append(folder / RESIDUAL)
        source_of = {
            "fit": result.config.name,
            "flights": result.fitted_flights,
            "rejected": {axis: c.rejected for axis, c in fit.choices.items() if c.rejected},
            "constants": {name: float(x) for name, x in values_of(result.fitted.constants).items()},
        }
        write_residual(paths[-1], fit.residual, source_of)
    return paths


def as_json(result: Fit) -> dict[str, object]:
    """The numbers of the report; null for those that are not finite."""
    report: dict[str, object] = {
        "model": result.model,
        "flights": [log.name for log in result.logs],
        "constants": {
            name: {"value": value, "standard_error": estimate.errors[name], "axis": estimate.group}
            for estimate in result.estimates
            for name, value in estimate.constants.items()
        },
        "axes": {
            fit.group: {name: getattr(fit, name) for name in ("r_squared", "rmse", "condition")}
            for fit in result.estimates
            if fit.group in AXES
        },
        "battery": None if result.battery is None else vars(result.battery),
        "warnings": result.warnings,
        "split": {"by": result.split.by, "folds": list(result.split.names)},
        "training": _prediction_json(result, result.training),
        "held_out": {part.name: _prediction_json(result, part) for part in result.held_out},
        "held_out_pooled": _prediction_json(result, pooled(result.held_out)),
        "not_checked": {log.name: log.source["unchecked"] for log in result.logs},
        "choices": _choices_json(result.fitted),
        "choices_without": {name: _choices_json(model) for name, model in result.without.items()},
    }
    return json.loads(json.dumps(report), parse_constant=lambda _: None)


def _choices_json(model: FittedModel) -> dict[str, object]:
    """The choices of a residual's outputs, none without a residual."""
    choices = model.residual.choices if model.residual else {}
    return {axis: vars(choice) | {"gain": choice.gain} for axis, choice in choices.items()}


def text_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as text, aligned to the right but for the first."""
    table = Table(box=None, pad_edge=False)
    for index, name in enumerate(header):
        table.add_column(Text(name), justify="right" if index else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))
    return "\n".join([title, *render_lines(table)])


def _numbers(result: Fit, part: Prediction) -> dict[str, np.ndarray]:
    """Errors of a prediction by the names of ``COLUMNS``, (6,) each."""
    models = result.models(part).items()
    numbers = {f"rmse_{name}": part.rmse(modeled) for name, modeled in models}
    if result.fitted.residual:
        numbers["change"] = part.change
    return numbers | {f"r_squared_{name}": r_squared(part.measured, x) for name, x in models}


def _prediction_json(result: Fit, part: Prediction) -> dict[str, dict[str, float]]:
    columns = _numbers(result, part).items()
    return {axis: {k: float(v[i]) for k, v in columns} for i, axis in enumerate(AXES)}


def _notes(result: Fit) -> dict[str, dict[str, str]]:
    """A comment for every constant that a fit has, by model; none if it kept them."""
    if not result.config.nominal.fit:
        return {"motor": {}}
    names = {n for of in EQUATIONS[type(result.fitted.constants)].constants.values() for n in of}
    notes = {result.model: dict.fromkeys(names, "the base vehicle's")}
    for fit in result.estimates:
        model = "rate" if fit.group == "rate" else result.model
        kept = fit.group in result.kept
        for name in fit.constants:
            error = np.inf if kept else fit.errors[name]
            note = f"+- {error:.2g}" if np.isfinite(error) else "the base vehicle's"
            notes.setdefault(model, {})[name] = note
    return notes


def _constants(result: Fit) -> str:
    fitted = result.config.nominal.fit
    title = f"model {result.model}" if fitted else f"model {result.model}, if it were fitted"
    header = ("group", "constant", "value", "std. error", "rel.", "condition", "R^2")
    rows = [row for estimate in result.estimates for row in _rows(estimate)]
    lines = [text_table(title, header, rows)]
    return "\n".join([*lines, *(f"warning: {line}" for line in result.warnings)])


def _rows(estimate: Estimate) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for index, (name, value) in enumerate(estimate.constants.items()):
        error = estimate.errors[name]
        relative = 100.0 * error / max(abs(value), 1e-300)
        percent = f"{relative:.2g}%" if relative < 99.5 else ">99%"
        numbers = (f"{value:.5g}", f"{error:.2g}", percent if np.isfinite(error) else "-")
        quality = (f"{estimate.condition:.3g}", f"{estimate.r_squared:.4f}")
        head, tail = ("", ("", "")) if index else (estimate.group, quality)
        rows.append((head, name, *numbers, *tail))
    return rows


def _errors(result: Fit, title: str, part: Prediction) -> str:
    columns = {"": list(AXES)}
    for name, numbers in _numbers(result, part).items():
        label, form = COLUMNS[name]
        columns[label] = [f"{x:{form}}" for x in numbers]
    columns["unit"] = list(result.units.values())
    rows = list(zip(*columns.values(), strict=True))
    return text_table(f"{title} ({len(part.rows)} samples)", list(columns), rows)


def _by_flight(result: Fit) -> str:
    what = "the last part of each flight" if result.split.by == "time" else "each flight"
    explained = [
        (part.name, *(f"{x:.3f}" for x in r_squared(part.measured, part.full)))
        for part in result.held_out
    ]
    title = f"held out: R^2 of {what} by a fit without it"
    text = text_table(title, ("", *AXES), explained)
    if not result.fitted.residual:
        return text
    changes = np.array([part.change[2:] for part in result.held_out])
    rows = [(part.name, change) for part, change in zip(result.held_out, changes, strict=True)]
    rows += [("mean", changes.mean(axis=0)), ("worst", changes.max(axis=0))]
    cells = [(name, *(f"{100.0 * x:+.1f}%" for x in change)) for name, change in rows]
    title = "held out: change of the RMSE by the residual"
    return f"{text}\n\n{text_table(title, ('', *RESIDUAL_AXES), cells)}"


def _choices(result: Fit, choices: dict[str, Choice]) -> str:
    rows = [
        (
            axis,
            str(choice.epochs),
            f"{choice.scale:.2f}",
            f"{100.0 * choice.gain:.1f}%",
            " ".join(f"{100.0 * gain:+.1f}%" for gain in choice.gains),
        )
        for axis, choice in choices.items()
    ]
    title, header = "the written residual", ("axis", "epochs", "scale", "gain", "per fold")
    if result.config.residual.select:
        title = f"{title}, selected on held-out folds"
    lines = [text_table(title, header, rows)]
    if result.config.residual.select:
        lines.append(
            "scale: chosen so that a training without a fold, scaled, increases no fold's error by "
            f"more than {100.0 * result.config.residual.max_harm:g}%"
        )
    rejected = {axis: c.rejected for axis, c in choices.items() if c.rejected}
    lines += [f"rejected: {a}: {reason}; written as zero" for a, reason in rejected.items()]
    if len(rejected) == len(choices):
        lines.append("the written residual adds nothing: train without +residual")
    return "\n".join(lines)


def write_figures(result: Fit, folder: Path) -> list[Path]:
    """Write every figure; return the paths."""
    figures = {}
    for part in result.held_out:
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in part.name)
        figures[f"held_out_{name}"] = traces_figure(result, part, f"held out: {part.name}")
    for index, log in enumerate(result.logs):
        rows = result.samples.flight[result.training.rows] == index
        if rows.any():
            title = f"training: {log.name}"
            figures[f"training_{log.name}"] = traces_figure(result, result.training[rows], title)
    figures["errors"] = errors_figure(result)
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png", dpi=80)
    return [folder / f"{name}.png" for name in figures]


def traces_figure(result: Fit, part: Prediction, title: str = "") -> Figure:
    """Errors of the nominal model, and of it with the residual, against time; a panel per axis.

    Of rows such as one of ``result.held_out``. The signals themselves differ by less than a line's
    width. Each panel has the RMSE of both.
    """
    figure = new_figure(10, 11)
    panels = figure.subplots(len(AXES), 1, sharex=True)
    time = result.samples.time[part.rows]
    every = max(1, len(time) // POINTS)
    # Break lines at jumps of time: another flight of the group, or a pause on the ground.
    jump = np.flatnonzero(np.abs(np.diff(time[::every])) > 0.5) + 1
    for i, (axis, axes) in enumerate(zip(AXES, panels, strict=True)):
        tidy(axes)
        unit, sizes = result.units[axis].replace("^2", "²"), []
        for name, model in result.models(part).items():
            error = part.measured[:, i] - model[:, i]
            line = (np.insert(x, jump, np.nan) for x in (time[::every], error[::every]))
            axes.plot(*line, color=COLORS[name], label=LABELS[name], lw=0.9)
            sizes.append(f"{np.sqrt(np.mean(error**2)):.3g}")
        axes.axhline(0.0, color=INK, lw=0.8)
        axes.set_ylabel(f"{axis} ({unit})", color=INK)
        note = f"RMSE {' → '.join(sizes)} {unit}"
        axes.set_title(note, loc="right", fontsize=8, color=INK, pad=2)
    head(panels[0], f"error of the model, {title}" if title else "error of the model")
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure


def errors_figure(result: Fit) -> Figure:
    """Histograms of both models' errors on training rows and on held-out rows."""
    sets = {"training": result.training, "held out": pooled(result.held_out)}
    figure = new_figure(16, 3.2 * len(sets))
    panels = figure.subplots(len(sets), len(AXES), squeeze=False)
    for row, (title, part) in zip(panels, sets.items(), strict=True):
        for i, (axis, axes) in enumerate(zip(AXES, row, strict=True)):
            tidy(axes)
            models = result.models(part)
            errors = {name: part.measured[:, i] - model[:, i] for name, model in models.items()}
            limit = max(float(np.percentile(np.abs(errors["nominal"]), 99.5)), 1e-12)
            style = {"bins": np.linspace(-limit, limit, 61), "histtype": "step", "density": True}
            for name, error in errors.items():
                axes.hist(error, label=LABELS[name], color=COLORS[name], **style)
            axes.set_yticks([])
            axes.locator_params(axis="x", nbins=3)
            unit = result.units[axis].replace("^2", "²")
            axes.set_xlabel(f"error of {axis} ({unit})", color=INK)
        row[0].set_ylabel(title, color=INK)
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return figure
