"""A flight log replayed: its laps, a policy's commands in its states, and a model's predictions."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from quadjax.config.assembly import make_environment, make_params
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.core.provenance import provenance
from quadjax.evaluation.figures import trajectory_figure
from quadjax.evaluation.report import FORMATS
from quadjax.evaluation.responses import Response, error_figure
from quadjax.evaluation.table import Table
from quadjax.export import emulator
from quadjax.export.network import convert
from quadjax.export.proof import prove
from quadjax.export.race_source import PolicyRace
from quadjax.export.states import LAST_COMMAND, observe, state_sizes
from quadjax.flights.flight import Flight
from quadjax.flights.gates import MEASURED_MARGIN_M
from quadjax.policy.file import Policy
from quadjax.policy.pilot import command_ranges
from quadjax.race.track import TrackSection
from quadjax.replay.log_states import (
    DISTURBANCES,
    estimate_disturbances,
    stack_states,
    vehicle_flight,
)
from quadjax.replay.predictions import Arrays, predict
from quadjax.vehicle.protocol import VehicleModel, VehicleParams

AT_LIMIT = 1e-3  # of a command's range
UNITS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}  # of errors
FILES = ("table.txt", "replay.json", "trajectory.*", "prediction.*", "commands.*")
PREDICTIONS = {"model": "rms_error", "unchanged": "rms_unchanged"}  # keys by label
LABELS = ("policy, fixed point", "policy")  # of commands
CELLS = {  # of a command: title and format
    "logged_mean": ("logged", ".4g"),
    "policy_mean": ("policy", ".4g"),
    "rms_difference": ("RMS diff.", ".4g"),
    "correlation": ("corr.", ".2f"),
    "at_limit": ("at limit", ".1%"),
    "fixed_error": ("fixed point", ".2g"),
}


def replay(
    log: Flight,
    track: TrackSection,
    drone: Config,
    race: PolicyRace | None,
    policy: Policy | None,
    drive: str | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> "Replay":
    """Replay a flight.

    Args:
        log: with position and attitude.
        track: that was flown.
        drone: whose vehicle predicts the flight.
        race: the policy's race, on the same track.
        policy: None for the laps and the model alone.
        drive: what drives the model: commands, speeds, or None: commands if the log has them.
        report: called with the progress.

    Raises:
        InputError: a log without a signal that is needed, or shorter than a window; in one line.
    """

    def flight_of(model: VehicleModel, params: VehicleParams) -> Flight:
        flight = vehicle_flight(log, model, params)
        return flight.with_passages(track.gates, MEASURED_MARGIN_M, track.closed)

    model, params, commands = make_environment(drone).model, make_params(drone).vehicle, None
    flight, gates = flight_of(model, params), track.gates
    where = f"{flight.name}: {drone.vehicle.name}, {track.name}"
    figures = {"trajectory": trajectory_figure([flight], gates, where)}
    if race is not None and policy is not None:
        report("commands of the policy")
        seen = flight_of(race.environment.model, race.params.vehicle)
        commands, response = _commands(seen, race, policy)
        title = f"{flight.name}: commands in the logged states"
        figures["commands"] = error_figure(seen, response, len(gates), title)
    report("predictions of the model")
    prediction, errors = predict(flight, model, params, drive)
    figures["prediction"] = _prediction_figure(prediction, errors, where)
    numbers = {
        "log": log.source["path"],
        "track": track.name,
        "seconds": float(flight.time[-1]),
        "sample_rate": 1.0 / flight.step,
        "gate_times": flight.passages[:, 0].round(4).tolist(),
        "lap_times": flight.lap_times.round(4).tolist(),
        "commands": commands,
        "prediction": prediction | {"residual": drone.vehicle.residual},
        "provenance": provenance(drone),
    }
    return Replay(numbers, figures)


@dataclasses.dataclass(frozen=True)
class Replay:
    """The comparison of a flight log with a policy and a model.

    Attributes:
        numbers: of the log, its laps, the commands and the predictions, as JSON takes them.
        figures: ``trajectory``, ``prediction`` and, with a policy, ``commands``.
    """

    numbers: dict[str, Any]
    figures: dict[str, Figure]

    def table(self) -> str:
        """Laps, commands and prediction errors as text."""
        numbers, laps = self.numbers, self.numbers["lap_times"]
        rate, track, passed = numbers["sample_rate"], numbers["track"], len(numbers["gate_times"])
        lines = [f"{numbers['log']}: {numbers['seconds']:.2f} s of flight at {rate:.0f} Hz", ""]
        if passed:
            lines.append(f"laps: {len(laps)} of the track {track}, {passed} gates passed")
            lines += [f"  lap {number}  {lap:8.3f} s" for number, lap in enumerate(laps, start=1)]
        else:
            lines.append(f"laps: no gate of the track {track} is passed (--track)")
        if numbers["commands"] is not None:
            lines += ["", _commands_table(numbers["commands"]).format()]
        return "\n".join([*lines, "", _prediction_table(numbers["prediction"]).format()])

    def write(self, folder: Path) -> None:
        """Write the table, the numbers and the figures to a folder: ``FILES``."""
        write_text(folder / "table.txt", self.table() + "\n")
        write_json(folder / "replay.json", self.numbers)
        for label, figure in self.figures.items():
            save_figure(figure, *(folder / f"{label}.{suffix}" for suffix in FORMATS))


def _commands(flight: Flight, race: PolicyRace, policy: Policy) -> tuple[dict[str, Any], Response]:
    """Commands in the logged states: numbers as JSON takes them, and over time.

    The logged commands, the policy's, and its fixed-point ones; NaN where one is missing.
    """
    model, logged, source = race.environment.model, None, "logged commands"
    if "command" in flight.signals:
        logged = flight["command"]
    elif [signal[1:] for signal in model.commands] == [model.actuators[1:]]:
        source = f"logged {model.actuators.name} (no commands in the log)"
        logged = flight["actuators"] if "actuators" in flight.signals else None
    observations, disturbance = _observations(flight, race, logged)
    low, high = policy.command_low, policy.command_high
    action = np.asarray(jax.jit(policy.mean)(observations), np.float64)
    values = low + 0.5 * (high - low) * (action + 1.0)
    logged = np.full_like(values, np.nan) if logged is None else logged
    fixed, inside, record = _fixed_point(policy, observations)
    names = [(x, f"_{i + 1}" * (x.size > 1)) for x in model.commands for i in range(x.size)]
    labels, units = [x.name + number for x, number in names], [x.unit for x, _ in names]
    response = Response(logged, fixed, values, low, high, labels, units, (*LABELS, source))
    with np.errstate(invalid="ignore"):  # of commands that do not change
        correlation = np.corrcoef(values.T, logged.T)
    at_limit = np.minimum(values - low, high - values) < AT_LIMIT * (high - low)
    columns = {
        "logged_mean": logged.mean(axis=0),
        "policy_mean": values.mean(axis=0),
        "rms_difference": response.rms,
        "correlation": np.diagonal(correlation, len(low)),
        "at_limit": at_limit.mean(axis=0),
        "fixed_error": np.fmax.reduce(np.abs(fixed - values)[inside], axis=0, initial=np.nan),
    }
    rows = [
        {"command": label, "unit": unit}
        | {key: float(x[i]) if np.isfinite(x[i]) else None for key, x in columns.items()}
        for i, (label, unit) in enumerate(zip(labels, units, strict=True))
    ]
    compared = source if np.isfinite(logged).any() else None
    about = {"compared_with": compared, "disturbance": disturbance or None, "each": rows}
    return record | about, response


def _fixed_point(
    policy: Policy, observations: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Commands (n, k) of the exported C, whether no input of a sample is clipped (n,), and numbers.

    The commands are fixed-point, NaN for a policy that cannot be exported; numbers are for JSON.
    """
    record: dict[str, Any] = {"clipped_inputs": {}, "not_clipped": 1.0}
    try:
        network = convert(policy)
        prove(network, policy)
    except InputError as error:
        nothing = np.full((len(observations), len(policy.command_low)), np.nan)
        return nothing, np.ones(len(nothing), bool), record | {"fixed_point": str(error)}
    beyond = np.abs(observations) > network.box.ranges
    inside, shares = ~beyond.any(axis=1), beyond.mean(axis=0).tolist()
    clipped = {x: share for x, share in zip(policy.layout.labels, shares, strict=True) if share}
    record = {"clipped_inputs": clipped, "not_clipped": float(inside.mean())}
    record["fixed_point"] = "as the exported C"
    return emulator.commands(network, observations), inside, record


def _observations(
    flight: Flight, race: PolicyRace, commands: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """Observations (n, inputs) float32, in the scaling of training, and their disturbances."""
    layout, model = race.environment.layout, race.environment.model
    sizes, more = state_sizes(layout, model), {}
    if LAST_COMMAND in sizes and commands is not None:
        low, high = command_ranges(race.environment, race.params)
        more[LAST_COMMAND] = np.concatenate([[0.5 * (low + high)], commands[:-1]])
    observed = [name for name in layout.names if name in DISTURBANCES]
    estimates = estimate_disturbances(flight, model, race.params.vehicle) if observed else {}
    source = "taken as zero, as the model has no estimator" if observed else ""
    if observed and layout[observed[0]].source == "none":
        source = "zero, as in the training of the policy"
    elif estimates:
        more |= estimates
        simulated = "" if flight.source["measured"] else " with simulated rotor speeds"
        source = f"estimated from the log{simulated}"
    states = stack_states(flight, model, sizes, more)
    return observe(race, states, flight.target.astype(np.int32)), source


def _commands_table(numbers: dict[str, Any]) -> Table:
    """The policy's commands next to the logged ones, a line for each."""
    rows = [
        [f"{row['command']} ({row['unit']})" if row["unit"] else row["command"]]
        + ["-" if row[key] is None else f"{row[key]:{form}}" for key, (_, form) in CELLS.items()]
        for row in numbers["each"]
    ]
    notes = [f"the policy's commands next to the {numbers['compared_with'] or 'log'}"]
    if numbers["disturbance"]:
        notes.append(f"observed external moment and force: {numbers['disturbance']}")
    where = f", where no input is clipped ({numbers['not_clipped']:.1%} of the samples)"
    notes.append(f"fixed point: {numbers['fixed_point']}" + where * (rows[0][-1] != "-"))
    for name, share in numbers["clipped_inputs"].items():
        notes.append(f"input {name}: {share:.1%} of the samples are clipped to its range")
    return Table(["command", *(title for title, _ in CELLS.values())], rows, notes=notes)


def _prediction_table(numbers: dict[str, Any]) -> Table:
    """RMS errors, a line for each quantity of the model and of the drone that does not change."""
    rows = [
        [f"{name} ({unit}), {label}", *(f"{error:.3g}" for error in numbers[key][name])]
        for name, unit in UNITS.items()
        for label, key in PREDICTIONS.items()
    ]
    model, residual = numbers["model"], numbers["residual"] or "none"
    notes = [
        f"model {model} (residual: {residual}), driven by the logged {numbers['drive']}",
        f"{numbers['windows']} windows; unchanged: constant velocity and body rates",
    ]
    titles = ["RMS prediction error", *(f"{seconds:.3g} s" for seconds in numbers["horizons"])]
    return Table(titles, rows, notes=notes)


def _prediction_figure(numbers: dict[str, Any], errors: dict[str, Arrays], where: str) -> Figure:
    """Root mean square errors against the horizon, with the range of 10 to 90% of the windows."""
    figure, horizons = new_figure(10, 6), numbers["horizons"]
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes in panels:  # before the scales, which the panels share
        tidy(axes)
    for axes, (name, unit) in zip(panels, UNITS.items(), strict=True):
        for (label, key), color in zip(PREDICTIONS.items(), (SERIES[0], SERIES[3]), strict=True):
            axes.plot(horizons, numbers[key][name], "o-", color=color, label=label)
            low, high = np.percentile(errors[key][name], (10, 90), axis=0)
            axes.fill_between(horizons, low, high, color=color, alpha=0.15, lw=0)
        axes.set(xscale="log", yscale="log")
        axes.set_ylabel(f"error of {name} ({unit})", color=INK)
    head(panels[0], f"{where}\nprediction, driven by the logged {numbers['drive']}")
    for axes in panels[2:]:
        axes.set_xlabel("horizon (s)", color=INK)
    return figure
