"""Replay a flight log: laps, a policy's commands, and a model's prediction errors."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.race import build_params, choices_of
from quadjax.config.schema import Config
from quadjax.core.plotting import save_figure
from quadjax.evaluation.figures import trajectory_figure
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import example_state
from quadjax.fitting.flight_log import FlightLog
from quadjax.flights.flight import Flight, motion_signals
from quadjax.flights.gates import REACH, passages
from quadjax.policy.file import Policy
from quadjax.race.track import TrackSection
from quadjax.studies.replay.commands import Replayed, differences, replay_commands
from quadjax.studies.replay.figures import commands_figure, prediction_figure
from quadjax.studies.replay.logged import Logged, logged
from quadjax.studies.replay.prediction import QUANTITIES, Prediction, predict

FORMATS = ("pdf", "svg", "png")
FILES = ("table.txt", "replay.json", "trajectory.*", "prediction.*", "commands.*")


@dataclass(frozen=True)
class Replay:
    """A flight log, and what a policy and a model make of it."""

    flight: Logged
    track: TrackSection
    gate_times: np.ndarray  # (passed,) s
    lap_times: np.ndarray  # (completed laps,) s; the first from the first sample in flight
    commands: Replayed | None  # None without a policy
    model: str
    prediction: Prediction
    residual: str | None = None  # file of the model's residual


def replay(
    log: FlightLog,
    track: TrackSection,
    drone: Config,
    own: OwnRace | None,
    policy: Policy | None,
    drive: str | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Replay:
    """Replay a flight.

    Args:
        log: with position and attitude.
        track: that was flown.
        drone: whose vehicle predicts the flight.
        own: the policy's race, on the same track.
        policy: None for the laps and the model alone.
        drive: what drives the model: commands, speeds, or None: commands if the log has them.
        report: called with the progress.

    Raises:
        InputError: a log without a signal that is needed, or shorter than a window; in one line.
    """
    choices, params = choices_of(drone), build_params(drone)
    flight = logged(log, choices.model, params.vehicle)
    options = {"reach": REACH, "closed": track.closed}
    times = passages(flight.time, flight.position, track.gates, **options)[:, 0]
    laps = np.diff(times[len(track.gates) - 1 :: len(track.gates)], prepend=0.0)
    commands = None
    if own is not None and policy is not None:
        report("commands of the policy")
        of_policy = logged(log, own.choices.model, own.params.vehicle)
        passed = np.searchsorted(times, flight.time, side="right")
        targets = passed % len(track.gates)
        commands = replay_commands(of_policy, targets, own, policy)
    report("predictions of the model")
    prediction = predict(
        flight, choices.model, params.vehicle, example_state(choices, params), drive
    )
    name, residual = choices.model.name, drone.vehicle.residual
    return Replay(flight, track, times, laps, commands, name, prediction, residual)


def tables(result: Replay) -> str:
    """The replay as text."""
    flight = result.flight
    lines = [f"{flight.path}: {flight.time[-1]:.2f} s of flight at {1.0 / flight.step:.0f} Hz"]
    for part in (_laps(result), _commands(result.commands), _prediction(result)):
        lines += ["", *part] if part else []
    return "\n".join(lines)


def numbers(result: Replay) -> dict[str, object]:
    """The numbers of a replay."""
    found, part = result.prediction, result.commands
    return {
        "log": result.flight.path,
        "seconds": float(result.flight.time[-1]),
        "sample_rate": 1.0 / result.flight.step,
        "gate_times": [round(float(x), 4) for x in result.gate_times],
        "lap_times": [round(float(x), 4) for x in result.lap_times],
        "commands": None
        if part is None
        else {
            "compared_with": part.source if part.logged is not None else None,
            "disturbance": part.disturbance or None,
            "each": differences(part),
            "clipped_inputs": part.clipped,
            "fixed_point": part.reason or "as the exported C",
        },
        "prediction": {
            "model": result.model,
            "residual": result.residual,
            "drive": found.drive,
            "windows": len(found.errors["position"]),
            "horizons": [float(x) for x in found.horizons],
            "rms_error": {name: _rms(values) for name, values in found.errors.items()},
            "rms_unchanged": {name: _rms(values) for name, values in found.unchanged.items()},
        },
    }


def write_figures(result: Replay, folder: Path) -> list[Path]:
    """Write ``trajectory``, ``prediction`` and, with a policy, ``commands`` as PDF, SVG, PNG."""
    paths = []
    for name, figure in _figures(result):
        for suffix in FORMATS:
            paths.append(folder / f"{name}.{suffix}")
            save_figure(figure, paths[-1])
    return paths


def _figures(result: Replay) -> Iterator[tuple[str, Figure]]:
    flight = result.flight
    ends = np.cumsum(result.lap_times)
    signals = motion_signals({"position": flight.position, "velocity": flight.velocity})
    flown = Flight(flight.name, flight.time, signals, lap_ends=ends)
    yield "trajectory", trajectory_figure([flown], result.track.gates, flight.name)
    yield "prediction", prediction_figure(result.prediction, result.model)
    if result.commands is not None:
        yield "commands", commands_figure(flight.time, result.commands)


def _rms(values: np.ndarray) -> list[float]:
    return [float(x) for x in np.sqrt((values**2).mean(axis=0))]


def _laps(result: Replay) -> list[str]:
    name, passed = result.track.name, len(result.gate_times)
    if not passed:
        return [f"laps: no gate of the track {name} is passed (--track)"]
    lines = [f"laps: {len(result.lap_times)} of the track {name}, {passed} gates passed"]
    lines += [f"  lap {i + 1}  {lap:8.3f} s" for i, lap in enumerate(result.lap_times)]
    return lines


def _commands(part: Replayed | None) -> list[str]:
    if part is None:
        return []
    lines = [
        f"the policy's commands next to the {part.source if part.logged is not None else 'log'}",
        f"  {'command':17}{'unit':>7}{'logged':>10}{'policy':>10}{'RMS diff.':>11}{'corr.':>7}"
        f"{'at limit':>10}",
    ]
    for row in differences(part):
        cells = "".join(
            f"{'-' if row[key] is None else format(row[key], form):>{wide}}"
            for key, form, wide in (
                ("logged_mean", ".4g", 10),
                ("policy_mean", ".4g", 10),
                ("rms_difference", ".4g", 11),
                ("correlation", ".2f", 7),
                ("at_limit", ".1%", 10),
            )
        )
        lines.append(f"  {row['command']:17}{row['unit']:>7}{cells}")
    if part.disturbance:
        lines.append(f"  observed external moment and force: {part.disturbance}")
    if part.fixed is None:
        return [*lines, f"  fixed point: not converted: {part.reason}"]
    worst = np.abs(part.fixed - part.policy)[part.inside] / (part.high - part.low)
    lines.append(
        "  fixed point: as the exported C, "
        f"{_largest(worst)} of a command's range from the floats where no input is clipped "
        f"({part.inside.mean():.1%} of the samples)"
    )
    for name, share in part.clipped.items():
        lines.append(f"  input {name}: {share:.1%} of the samples are clipped to its range")
    return lines


def _largest(values: np.ndarray) -> str:
    return f"at most {values.max():.2g}" if values.size else "unknown part"


def _prediction(result: Replay) -> list[str]:
    found = result.prediction
    head = "".join(f"{f'{seconds:.3g} s':>10}" for seconds in found.horizons)
    count = len(found.errors["position"])
    lines = [
        f"RMS prediction error of the model {result.model}, driven by the logged {found.drive}, "
        f"{count} windows",
        f"(residual: {result.residual or 'none'})",
        "(unchanged: of a drone with constant velocity and body rates)",
        f"  {'':27}{head}",
    ]
    for name, unit in QUANTITIES.items():
        for label, errors in (("model", found.errors), ("unchanged", found.unchanged)):
            cells = "".join(f"{value:10.3g}" for value in _rms(errors[name]))
            lines.append(f"  {name:10}{label:10}{unit:>7}{cells}")
    return lines
