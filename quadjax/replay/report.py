"""Text, numbers and figures of a replay."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.evaluation.figures import trajectory_figure
from quadjax.replay import Replay
from quadjax.replay.commands import Commands, differences
from quadjax.replay.prediction import QUANTITIES, Prediction
from quadjax.replay.states import step_of

FORMATS = ("pdf", "svg", "png")
FILES = ("table.txt", "replay.json", "trajectory.*", "prediction.*", "commands.*")
POINTS = 4000  # of a line, at most
CELLS = {  # of a command: format and width
    "logged_mean": (".4g", 10),
    "policy_mean": (".4g", 10),
    "rms_difference": (".4g", 11),
    "correlation": (".2f", 7),
    "at_limit": (".1%", 10),
}


def numbers(result: Replay) -> dict[str, Any]:
    """The numbers of a replay, as JSON takes them."""
    flight, commands, found = result.flight, result.commands, result.prediction
    of_policy = None
    if commands is not None:
        of_policy = {
            "compared_with": commands.source if commands.logged is not None else None,
            "disturbance": commands.disturbance or None,
            "each": differences(commands),
            "clipped_inputs": commands.clipped,
            "fixed_point": commands.reason or "as the exported C",
        }
    return {
        "log": flight.source["path"],
        "seconds": float(flight.time[-1]),
        "sample_rate": 1.0 / step_of(flight),
        "gate_times": [round(float(x), 4) for x in flight.passages[:, 0]],
        "lap_times": [round(float(x), 4) for x in flight.lap_times],
        "commands": of_policy,
        "prediction": {
            "model": result.model,
            "residual": result.residual,
            "drive": found.drive,
            "windows": len(found.errors["position"]),
            "horizons": found.horizons.tolist(),
            "rms_error": {name: _rms(values) for name, values in found.errors.items()},
            "rms_unchanged": {name: _rms(values) for name, values in found.unchanged.items()},
        },
    }


def _rms(values: np.ndarray) -> list[float]:
    return [float(x) for x in np.sqrt((values**2).mean(axis=0))]


def tables(result: Replay) -> str:
    """The replay as text."""
    found, flight = numbers(result), result.flight
    lines = [
        f"{found['log']}: {found['seconds']:.2f} s of flight at {found['sample_rate']:.0f} Hz",
        "",
    ]
    name, laps, passed = result.track.name, found["lap_times"], len(flight.passages)
    if passed:
        lines.append(f"laps: {len(laps)} of the track {name}, {passed} gates passed")
        lines += [f"  lap {i + 1}  {lap:8.3f} s" for i, lap in enumerate(laps)]
    else:
        lines.append(f"laps: no gate of the track {name} is passed (--track)")
    if result.commands is not None:
        lines += ["", *_command_lines(result.commands, found["commands"])]
    return "\n".join([*lines, "", *_prediction_lines(found["prediction"])])


def _command_lines(commands: Commands, found: dict[str, Any]) -> list[str]:
    lines = [
        f"the policy's commands next to the {found['compared_with'] or 'log'}",
        f"  {'command':17}{'unit':>7}{'logged':>10}{'policy':>10}{'RMS diff.':>11}{'corr.':>7}"
        f"{'at limit':>10}",
    ]
    for row in found["each"]:
        cells = "".join(
            f"{'-' if row[key] is None else format(row[key], form):>{wide}}"
            for key, (form, wide) in CELLS.items()
        )
        lines.append(f"  {row['command']:17}{row['unit']:>7}{cells}")
    if commands.disturbance:
        lines.append(f"  observed external moment and force: {commands.disturbance}")
    if commands.fixed is None:
        return [*lines, f"  fixed point: not converted: {commands.reason}"]
    errors = np.abs(commands.fixed - commands.policy)[commands.inside]
    errors = errors / (commands.high - commands.low)
    largest = f"at most {errors.max():.2g}" if errors.size else "an unknown part"
    lines.append(
        f"  fixed point: as the exported C, {largest} of a command's range from the floats where "
        f"no input is clipped ({commands.inside.mean():.1%} of the samples)"
    )
    return lines + [
        f"  input {name}: {share:.1%} of the samples are clipped to its range"
        for name, share in commands.clipped.items()
    ]


def _prediction_lines(found: dict[str, Any]) -> list[str]:
    lines = [
        f"RMS prediction error of the model {found['model']}, driven by the logged "
        f"{found['drive']}, {found['windows']} windows",
        f"(residual: {found['residual'] or 'none'})",
        "(unchanged: of a drone with constant velocity and body rates)",
        " " * 29 + "".join(f"{f'{seconds:.3g} s':>10}" for seconds in found["horizons"]),
    ]
    for name, unit in QUANTITIES.items():
        for label, key in (("model", "rms_error"), ("unchanged", "rms_unchanged")):
            cells = "".join(f"{value:10.3g}" for value in found[key][name])
            lines.append(f"  {name:10}{label:10}{unit:>7}{cells}")
    return lines


def write_figures(result: Replay, folder: Path) -> None:
    """Write ``trajectory``, ``prediction`` and, with a policy, ``commands`` as PDF, SVG, PNG."""
    for name, figure in _figures(result):
        for suffix in FORMATS:
            save_figure(figure, folder / f"{name}.{suffix}")


def _figures(result: Replay) -> Iterator[tuple[str, Figure]]:
    flight = result.flight
    yield "trajectory", trajectory_figure([flight], result.track.gates, flight.name)
    yield "prediction", prediction_figure(result.prediction, result.model)
    if result.commands is not None:
        yield "commands", commands_figure(flight.time, result.commands)


def commands_figure(time: np.ndarray, commands: Commands) -> Figure:
    """Logged commands and the policy's, a panel for each.

    Args:
        time: (n,) s.
        commands: at these times.
    """
    count = len(commands.names)
    figure = new_figure(10, 1.0 + 1.9 * count)
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    every = max(1, len(time) // POINTS)
    lines = {
        commands.source: commands.logged,
        "policy": commands.policy,
        "policy, fixed point": commands.fixed,
    }
    styles = (("-", SERIES[3], 1.4), ("-", SERIES[0], 1.0), (":", SERIES[1], 1.0))
    for i, axes in enumerate(panels):
        tidy(axes)
        for (label, values), (style, color, width) in zip(lines.items(), styles, strict=True):
            if values is not None:
                shown = values[::every, i]
                axes.plot(time[::every], shown, style, color=color, lw=width, label=label)
        unit = f" ({commands.units[i]})" if commands.units[i] else ""
        axes.set_ylabel(f"{commands.names[i]}{unit}", color=INK)
    head(panels[0], "commands in the logged states")
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure


def prediction_figure(found: Prediction, model: str) -> Figure:
    """Root mean square errors against the horizon, with the range of 10 to 90% of the windows."""
    figure = new_figure(10, 6)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    lines = {f"model {model}": (found.errors, SERIES[0]), "unchanged": (found.unchanged, SERIES[3])}
    for axes in panels:  # before the scales, which the panels share
        tidy(axes)
    for axes, (name, unit) in zip(panels, QUANTITIES.items(), strict=True):
        for label, (errors, color) in lines.items():
            values = np.maximum(errors[name], 1e-9)
            axes.plot(
                found.horizons, np.sqrt((values**2).mean(axis=0)), "o-", color=color, label=label
            )
            low, high = np.percentile(values, (10, 90), axis=0)
            axes.fill_between(found.horizons, low, high, color=color, alpha=0.15, lw=0)
        axes.set(xscale="log", yscale="log")
        axes.set_ylabel(f"error of {name} ({unit})", color=INK)
    head(panels[0], f"prediction, driven by the logged {found.drive}")
    for axes in panels[2:]:
        axes.set_xlabel("horizon (s)", color=INK)
    return figure
