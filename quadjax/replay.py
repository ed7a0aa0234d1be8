"""A flight log replayed: its laps, a policy's commands in its states, and a model's predictions."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from quadjax.config.assembly import make_choices, make_params
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.integrators import rk4_step
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.core.provenance import provenance
from quadjax.core.vectors import Rotors
from quadjax.evaluation.figures import trajectory_figure
from quadjax.evaluation.report import FORMATS
from quadjax.evaluation.table import Table
from quadjax.export import emulator
from quadjax.export.network import convert
from quadjax.export.proof import prove
from quadjax.export.race_source import PolicyRace
from quadjax.export.race_tables import LAST_COMMAND, state_sizes
from quadjax.export.states import drone_of, example_state, observe
from quadjax.fitting.signals import derivative, low_pass
from quadjax.flights.flight import MOTION, Flight
from quadjax.flights.gates import REACH
from quadjax.log_states import DISTURBANCES, disturbances_of, states_of, vehicle_flight
from quadjax.policy.file import Policy
from quadjax.policy.inference import mean_action, policy_params
from quadjax.policy.pilot import command_ranges
from quadjax.race.layout import Layout, split_name
from quadjax.race.track import TrackSection
from quadjax.vehicle.protocol import State, VehicleModel, VehicleParams
from quadjax.vehicle.racing import RacingConstants, command_of

AT_LIMIT = 1e-3  # of a command's range
RATE_ERROR = 0.05  # of a log's sample rate, of a policy that observes a history
HORIZONS = (0.1, 0.2, 0.5, 1.0)  # s
STRIDE = 0.1  # s, between the starts of windows
SMOOTH = 16.0  # Hz, of the speeds' derivative
UNITS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}  # of errors
FILES = ("table.txt", "replay.json", "trajectory.*", "prediction.*", "commands.*")
AS_IN_C = "as the exported C"
POINTS = 4000  # of a line, at most
CELLS = {  # of a command: title and format
    "logged_mean": ("logged", ".4g"),
    "policy_mean": ("policy", ".4g"),
    "rms_difference": ("RMS diff.", ".4g"),
    "correlation": ("corr.", ".2f"),
    "at_limit": ("at limit", ".1%"),
    "fixed_error": ("fixed point", ".2g"),
}
Arrays = dict[str, np.ndarray]


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
    choices, params = make_choices(drone), make_params(drone)
    flight = vehicle_flight(log, choices.model, params.vehicle)
    flight = flight.with_passages(track.gates, REACH, track.closed)
    figures = {"trajectory": trajectory_figure([flight], track.gates, flight.name)}
    of_policy = None
    if race is not None and policy is not None:
        report("commands of the policy")
        seen = vehicle_flight(log, race.choices.model, race.params.vehicle)
        seen = seen.with_passages(track.gates, REACH, track.closed)
        of_policy, commands = _policy_commands(seen, race, policy)
        figures["commands"] = _commands_figure(seen.time, of_policy["each"], commands)
    report("predictions of the model")
    example = example_state(choices, params)
    of_model, errors = _predict(flight, choices.model, params.vehicle, example, drive)
    figures["prediction"] = _prediction_figure(of_model, errors)
    numbers = {
        "log": log.source["path"],
        "track": track.name,
        "seconds": float(flight.time[-1]),
        "sample_rate": 1.0 / flight.step,
        "gate_times": [round(float(x), 4) for x in flight.passages[:, 0]],
        "lap_times": [round(float(x), 4) for x in flight.lap_times],
        "commands": of_policy,
        "prediction": of_model | {"residual": drone.vehicle.residual},
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


def _policy_commands(
    flight: Flight, race: PolicyRace, policy: Policy
) -> tuple[dict[str, Any], Arrays]:
    """Commands in the logged states: numbers as JSON takes them, and commands (n, k) by label.

    Logged ones, the policy's, and those in fixed point, as far as there are any.
    """
    model, logged, source = race.choices.model, None, "logged commands"
    if "command" in flight.signals:
        logged = flight["command"]
    elif [signal[1:] for signal in model.commands] == [model.actuators[1:]]:
        source = f"logged {model.actuators.name} (no commands in the log)"
        logged = flight["actuators"] if "actuators" in flight.signals else None
    observations, disturbance = _observations(flight, race, logged)
    action = np.clip(np.asarray(jax.jit(mean_action)(policy_params(policy), observations)), -1, 1)
    low, high = (np.asarray(end, np.float64) for end in (policy.command_low, policy.command_high))
    values = low + 0.5 * (high - low) * (action.astype(np.float64) + 1.0)
    commands = ({} if logged is None else {source: logged}) | {"policy": values}
    at_limit = np.minimum(values - low, high - values) < AT_LIMIT * (high - low)
    columns = {"policy_mean": values.mean(axis=0), "at_limit": at_limit.mean(axis=0)}
    if logged is not None:
        one, two = values - values.mean(axis=0), logged - logged.mean(axis=0)
        product = np.sqrt((one**2).sum(axis=0) * (two**2).sum(axis=0))
        columns["logged_mean"] = logged.mean(axis=0)
        columns["rms_difference"] = np.sqrt(((values - logged) ** 2).mean(axis=0))
        columns["correlation"] = (one * two).sum(axis=0) / np.where(product > 0, product, np.nan)
    about: dict[str, Any] = {"clipped_inputs": {}, "not_clipped": 1.0, "fixed_point": AS_IN_C}
    try:
        network = convert(policy)
        prove(network, policy)
    except InputError as error:
        about["fixed_point"] = str(error)
    else:
        fixed = commands["policy, fixed point"] = emulator.commands(network, observations)
        beyond = np.abs(observations) > 2.0 ** np.array(network.box.exponents)
        inside, share = ~beyond.any(axis=1), beyond.mean(axis=0).tolist()
        clipped = dict(zip(policy.layout.labels, share, strict=True))
        about["clipped_inputs"] = {name: part for name, part in clipped.items() if part > 0}
        about["not_clipped"] = float(inside.mean())
        errors = np.where(inside[:, None], np.abs(fixed - values), np.nan)
        columns["fixed_error"] = np.fmax.reduce(errors, axis=0)
    names = [(s.name, s.unit, i) for s in model.commands for i in range(s.size)]
    sizes = {signal.name: signal.size for signal in model.commands}
    rows = [
        {"command": name if sizes[name] == 1 else f"{name}_{number + 1}", "unit": unit}
        | {key: _maybe(columns[key][i]) if key in columns else None for key in CELLS}
        for i, (name, unit, number) in enumerate(names)
    ]
    compared = None if logged is None else source
    about |= {"compared_with": compared, "disturbance": disturbance or None, "each": rows}
    return about, commands


def _maybe(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _observations(
    flight: Flight, race: PolicyRace, commands: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """Observations (n, inputs) float32, in the scaling of training, and their disturbances."""
    layout, model, step = race.choices.layout, race.choices.model, flight.step
    if layout.depth and abs(step / race.time_step - 1.0) > RATE_ERROR:
        raise InputError(
            f"{flight.source['path']}: {1.0 / step:.4g} samples/s; the policy observes a history, "
            f"which needs a log of {1.0 / race.time_step:.4g} samples/s"
        )
    sizes, more = state_sizes(layout, model), {}
    if LAST_COMMAND in sizes and commands is not None:
        low, high = command_ranges(race.choices, race.params)
        more[LAST_COMMAND] = np.concatenate([[0.5 * (low + high)], commands[:-1]])
    observed = [name for name in layout.names if split_name(name)[0] in DISTURBANCES]
    estimates = disturbances_of(flight, model, race.params.vehicle) if observed else {}
    source = "taken as zero, as the model has no estimator" if observed else ""
    if observed and layout[observed[0]].source == "none":
        source = "zero, as in the training of the policy"
    elif estimates:
        more |= estimates
        simulated = "" if flight.source["measured"] else " with simulated rotor speeds"
        source = f"estimated from the log{simulated}"
    states = states_of(flight, model, sizes, more)
    return observe(race, states, flight.target.astype(np.int32)), source


def _predict(
    flight: Flight,
    model: VehicleModel,
    params: VehicleParams,
    example: State,
    drive: str | None = None,
) -> tuple[dict[str, Any], dict[str, Arrays]]:
    """Errors over windows of a flight: numbers as JSON takes them, and arrays by label.

    Errors (windows, horizons) by quantity: of the model, and of a drone that keeps its velocity and
    body rates.
    """
    step, drive = flight.step, drive or ("commands" if "command" in flight.signals else "speeds")
    commands = _driving_commands(flight, model, params, drive)
    steps = np.array([1, *(max(1, round(horizon / step)) for horizon in HORIZONS)])
    starts = np.arange(0, len(flight.time) - steps[-1], max(1, round(STRIDE / step)))
    if not len(starts):
        raise InputError(
            f"{flight.source['path']}: {flight.time[-1]:.3g} s of flight, expected more than "
            f"{HORIZONS[-1]:g} s (the longest horizon)"
        )
    layout = Layout(())
    states = states_of(flight, model, state_sizes(layout, model), {})[starts]
    first = jax.vmap(lambda row: drone_of(layout, model, example, row))(states)
    rows = starts[:, None] + np.arange(steps[-1])
    speeds = np.float32(flight["actuators"][rows]) if drive == "speeds" else None
    modeled = _roll_out(model, params, first, np.float32(commands[rows]), speeds, step)
    motion = np.stack([flight[name] for name in MOTION], axis=1)  # (n, quantities, 3)
    unchanged, seconds = np.repeat(motion[starts, None], len(steps), axis=1), steps[:, None] * step
    unchanged[..., 0, :] += unchanged[..., 1, :] * seconds
    turn = Rotation.from_rotvec((unchanged[..., 3, :] * seconds).reshape(-1, 3))
    turned = (_rotation(unchanged[..., 2, :]) * turn).as_euler("ZYX")[:, ::-1]
    unchanged[..., 2, :] = turned.reshape(unchanged[..., 2, :].shape)
    truth = motion[starts[:, None] + steps]
    ahead = np.asarray(modeled, np.float64)[:, steps - 1]
    label = f"model {model.name}"
    errors = {label: _errors(ahead, truth), "unchanged": _errors(unchanged, truth)}
    rms = [
        {name: np.sqrt((values**2).mean(axis=0)).tolist() for name, values in errors_of.items()}
        for errors_of in errors.values()
    ]
    numbers = {"model": model.name, "drive": drive, "windows": len(starts)}
    numbers |= {"horizons": (steps * step).tolist(), "rms_error": rms[0], "rms_unchanged": rms[1]}
    return numbers, errors


def _rotation(angles: np.ndarray) -> Rotation:
    """Rotations of roll, pitch and yaw (.., 3), in one row."""
    return Rotation.from_euler("ZYX", angles[..., ::-1].reshape(-1, 3))


def _errors(motion: np.ndarray, truth: np.ndarray) -> Arrays:
    """Errors (windows, horizons) by quantity of motions (windows, horizons, quantities, 3)."""
    errors = np.linalg.norm(motion - truth, axis=-1)
    turn = _rotation(motion[..., 2, :]).inv() * _rotation(truth[..., 2, :])
    errors[..., 2] = np.degrees(turn.magnitude()).reshape(errors.shape[:2])
    return dict(zip(UNITS, np.moveaxis(errors, -1, 0), strict=True))


@functools.partial(jax.jit, static_argnames="model")
def _roll_out(
    model: VehicleModel,
    params: VehicleParams,
    first: State,
    commands: jax.Array,
    speeds: jax.Array | None,
    dt: float,
) -> jax.Array:
    """Motions (windows, steps, quantities, 3) after each step of dt s, from states ``first``.

    Commands (windows, steps, k) are held for a step; speeds (windows, steps, 4), rad/s or rpm, are
    those of the rotors at its start.
    """
    structure = jax.tree.structure(model.command_range(params.constants)[0])

    def step(state: State, inputs: tuple[jax.Array, jax.Array | None]) -> tuple[State, jax.Array]:
        numbers, speed = inputs
        command = jax.tree.unflatten(structure, list(numbers))
        state = state if speed is None else state.replace(actuators=Rotors.of(speed))
        state = rk4_step(lambda s: model.derivative(params, s, command), state, dt)
        state = model.hold(state.wrapped(), command)
        vectors = (state.position, state.velocity, state.angles, state.rates)
        return state, jnp.stack([vector.array() for vector in vectors])

    return jax.vmap(lambda *start: jax.lax.scan(step, *start)[1])(first, (commands, speeds))


def _driving_commands(
    flight: Flight, model: VehicleModel, params: VehicleParams, drive: str
) -> np.ndarray:
    """Commands (n, k): the logged ones, or those under which rotors accelerate as logged."""
    names = [signal.name for signal in model.commands]
    measured = flight.source["measured"] and names in (["rpm"], ["motor_command"])
    if drive == "speeds" and not measured:
        raise InputError(
            f"{flight.source['path']}: no measured rotor speeds for the model {model.name}, "
            f"expected {', '.join(names)}"
        )
    if "command" in flight.signals:
        return flight["command"]
    if drive == "commands":
        raise InputError(
            f"{flight.source['path']}: no commands of the model {model.name} ({', '.join(names)})"
        )
    speed, rate, constants = flight["actuators"], 1.0 / flight.step, params.constants
    change = derivative(low_pass(speed, rate, min(SMOOTH, 0.2 * rate)), rate)
    steady = speed + float(constants.tau) * change
    if not isinstance(constants, RacingConstants):
        return steady
    return np.asarray(command_of(constants, Rotors.of(jnp.asarray(steady))).array())


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
        for label, key in (("model", "rms_error"), ("unchanged", "rms_unchanged"))
    ]
    model, residual = numbers["model"], numbers["residual"] or "none"
    notes = [
        f"model {model} (residual: {residual}), driven by the logged {numbers['drive']}",
        f"{numbers['windows']} windows; unchanged: constant velocity and body rates",
    ]
    titles = ["RMS prediction error", *(f"{seconds:.3g} s" for seconds in numbers["horizons"])]
    return Table(titles, rows, notes=notes)


def _commands_figure(time: np.ndarray, rows: list[dict[str, Any]], commands: Arrays) -> Figure:
    """Logged commands and the policy's over time (n,), s, a panel for each."""
    figure, every = new_figure(10, 1.0 + 1.9 * len(rows)), max(1, len(time) // POINTS)
    panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    styles = {"policy": ("-", SERIES[0], 1.0), "policy, fixed point": (":", SERIES[1], 1.0)}
    for i, (axes, row) in enumerate(zip(panels, rows, strict=True)):
        tidy(axes)
        for label, values in commands.items():
            style, color, width = styles.get(label, ("-", SERIES[3], 1.4))
            axes.plot(time[::every], values[::every, i], style, color=color, lw=width, label=label)
        unit = f" ({row['unit']})" if row["unit"] else ""
        axes.set_ylabel(f"{row['command']}{unit}", color=INK)
    head(panels[0], "commands in the logged states")
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure


def _prediction_figure(numbers: dict[str, Any], errors: dict[str, Arrays]) -> Figure:
    """Root mean square errors against the horizon, with the range of 10 to 90% of the windows."""
    figure, horizons = new_figure(10, 6), numbers["horizons"]
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes in panels:  # before the scales, which the panels share
        tidy(axes)
    for axes, (name, unit) in zip(panels, UNITS.items(), strict=True):
        for (label, table), color in zip(errors.items(), (SERIES[0], SERIES[3]), strict=True):
            values = np.maximum(table[name], 1e-9)
            rms = np.sqrt((values**2).mean(axis=0))
            axes.plot(horizons, rms, "o-", color=color, label=label)
            low, high = np.percentile(values, (10, 90), axis=0)
            axes.fill_between(horizons, low, high, color=color, alpha=0.15, lw=0)
        axes.set(xscale="log", yscale="log")
        axes.set_ylabel(f"error of {name} ({unit})", color=INK)
    head(panels[0], f"prediction, driven by the logged {numbers['drive']}")
    for axes in panels[2:]:
        axes.set_xlabel("horizon (s)", color=INK)
    return figure
