"""Matplotlib figures of flights over time, of lap times, and of gaps between flights."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.errors import InputError
from quadjax.core.plotting import INK, MUTED, PAPER, SERIES, head, new_figure, tidy
from quadjax.evaluation.figures import MANY, Groups, colors_of
from quadjax.evaluation.table import counted
from quadjax.fitting.signals import first_order
from quadjax.flights.flight import RATES, Flight

STYLES = ("-", "--", "-.", ":")
MODELS = {"rpm": "motor", "rad/s": "rate"}  # vehicle model by the unit of the commands


def signals_figure(flight: Flight, title: str = "") -> Figure:
    """Actuators and body rates of a flight over time, with the commanded thrust and its laps.

    Args:
        flight: one run.
        title: of the figure.
    """
    figure = new_figure(9.0, 5.6)
    above, below = figure.subplots(2, 1, sharex=True)
    actuators = flight.signals["actuators"]
    labels = actuators.labels or [str(i + 1) for i in range(actuators.values.shape[1])]
    for values, label, color in zip(actuators.values.T, labels, SERIES, strict=False):
        above.plot(flight.time, values, color=color, lw=1.1, label=label)
    if actuators.values.shape[1] == 1:
        command = flight["command"][:, 3]
        above.plot(flight.time, command, color=MUTED, lw=0.8, zorder=1, label="commanded")
    names = {"rpm": "propeller speed (rpm)", "m/s^2": "specific thrust (m/s²)"}
    above.set_ylabel(names.get(str(actuators.unit), f"actuators ({actuators.unit})"), color=INK)
    for axis, name in enumerate(RATES):
        below.plot(flight.time, flight["rates"][:, axis], color=SERIES[axis], lw=1.2, label=name)
    below.set_ylabel("body rate (rad/s)", color=INK)
    below.set_xlabel("time (s); dashed: a lap's end", color=INK)
    for axes in (above, below):
        tidy(axes)
        axes.margins(x=0.01)
        _mark_laps(axes, flight)
    head(above, title)
    head(below)
    return figure


def attitude_figure(flights: Mapping[str, Flight], title: str = "") -> Figure:
    """Height, speed, roll, pitch and yaw of flights over time.

    Args:
        flights: by their names, at most as many as there are colors.
        title: of the figure.

    Raises:
        InputError: no flight, or more than colors.
    """
    if not 0 < len(flights) <= len(SERIES):
        raise InputError(f"{len(flights)} flights to draw, allowed: 1 to {len(SERIES)}")
    figure, several = new_figure(9.0, 8.0), len(flights) > 1
    panels = figure.subplots(5, 1, sharex=True)
    for (name, flight), color in zip(flights.items(), SERIES, strict=False):
        angles = np.degrees(np.unwrap(flight["attitude"], axis=0)).T
        rows = (-flight["position"][:, 2], flight.speed, *angles)
        for axes, values in zip(panels, rows, strict=True):
            axes.plot(flight.time, values, color=color, lw=1.3, label=name if several else None)
            if not several:
                _mark_laps(axes, flight)
    labels = ("height (m)", "speed (m/s)", "roll (deg)", "pitch (deg)", "yaw (deg)")
    for axes, label in zip(panels, labels, strict=True):
        tidy(axes)
        axes.margins(x=0.01)
        axes.set_ylabel(label, color=INK)
    panels[-1].set_xlabel("time (s)", color=INK)
    head(panels[0], title)
    return figure


def _mark_laps(axes: Axes, flight: Flight) -> None:
    for end in flight.lap_ends:
        axes.axvline(end, color=MUTED, lw=0.9, ls="--", zorder=0)


def box_figure(groups: Groups) -> Figure:
    """Box plots of lap 1, of the laps after it and of the total, a box for each group.

    Boxes from the first to the third quartile with the median, whiskers to the last flight within
    1.5 times their range, and a dot for each flight. Flights that did not finish count in the laps
    that they completed.
    """
    colors = colors_of(groups)
    figure = new_figure(9.6, 1.1 + 0.5 * len(groups))
    most = max(len(f.lap_times) for flights in groups.values() for f in flights)
    panels = figure.subplots(1, 3, sharey=True)
    times_by_panel: dict[str, Callable[[Flight], Sequence[float]]] = {
        "lap 1 (s)": lambda f: f.lap_times[:1].tolist(),
        f"laps 2 to {most} (s)" if most > 2 else "lap 2 (s)": lambda f: f.lap_times[1:].tolist(),
        f"total of {counted(most, 'lap')} (s)": lambda f: [f.total] * (len(f.lap_times) == most),
    }
    for axes, (label, times_of) in zip(panels, times_by_panel.items(), strict=True):
        tidy(axes)
        axes.grid(False, axis="y")
        for place, (group, flights) in enumerate(groups.items()):
            times = np.array([time for flight in flights for time in times_of(flight)], float)
            _box(axes, times[np.isfinite(times)], place, colors[group])
        axes.set_xlabel(label, color=INK)
        axes.margins(x=0.08)
    panels[0].set_yticks(range(len(groups)), list(groups))
    panels[0].set_ylim(len(groups) - 0.4, -0.6)
    return figure


def _box(axes: Axes, times: np.ndarray, place: int, color: Sequence[float]) -> None:
    line = {"color": color, "lw": 1.4}
    if times.size > 1:
        axes.boxplot(
            times,
            positions=[place],
            orientation="horizontal",
            widths=0.5,
            showfliers=False,
            manage_ticks=False,
            patch_artist=True,
            boxprops={"facecolor": PAPER, "edgecolor": color, "lw": 1.4},
            medianprops=line | {"lw": 2.2},
            whiskerprops=line,
            capprops=line,
        )
    spread = 0.12 * np.sin(2.4 * np.arange(times.size))  # so that equal times do not cover
    axes.plot(times, place + spread, "o", ms=3, color=color, alpha=0.6, mec="none", zorder=3)


def gap_figure(groups: Groups, gates: int) -> Figure:
    """Time behind the flight that is first at each gate, of all flights.

    First among the flights that pass the most gates: one that crashed may have been ahead.

    Args:
        groups: of flights.
        gates: of the track.
    """
    colors = colors_of(groups)
    figure = new_figure(9.6, 4.2)
    axes = figure.add_subplot()
    tidy(axes)
    every = [gate_times(flight) for flights in groups.values() for flight in flights]
    most = max(map(len, every))
    leader = np.min([times for times in every if len(times) == most], axis=0)
    for index, (group, flights) in enumerate(groups.items()):
        few = len(flights) <= MANY
        style: dict[str, Any] = {"color": colors[group], "lw": 1.8 if few else 0.8}
        style |= {"alpha": 1.0 if few else 0.5}
        for number, flight in enumerate(flights):
            times = gate_times(flight)
            behind, places = times - leader[: len(times)], np.arange(1, len(times) + 1)
            line = STYLES[index % len(STYLES)] if len(flights) == 1 else "-"
            label = f"{group} ({counted(len(flights), 'flight')})" if number == 0 else None
            axes.plot(places, behind, line, label=label, **style)
            if flight.crash and len(behind):
                axes.plot(len(behind), behind[-1], "x", color=colors[group], ms=8, mew=2)
    for lap in range(gates, most + 1, gates):
        axes.axvline(lap, color=MUTED, lw=0.9, ls="--", zorder=0)
    axes.set_xlim(1, most + 0.15)
    ahead = any(np.any(times < leader[: len(times)]) for times in every)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]) if ahead else 0.0)
    axes.set_xlabel("gate; dashed: the end of a lap", color=INK)
    axes.set_ylabel("behind the first at each gate (s)", color=INK)
    figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, fontsize=9)
    return figure


def gate_times(flight: Flight) -> np.ndarray:
    """Time of each passage of a gate (k,), s."""
    return flight.passages[:, 0]


@dataclasses.dataclass(frozen=True)
class Response:
    """A flight's commanded signals, their limits and the model's response to the commands."""

    actual: np.ndarray  # (n, k)
    command: np.ndarray  # (n, k)
    model: np.ndarray  # (n, k) first-order response to the commands
    low: np.ndarray  # (k,)
    high: np.ndarray  # (k,)
    names: Sequence[str]
    unit: str

    @property
    def error(self) -> np.ndarray:
        """The difference from the model's response, (n, k)."""
        return self.actual - self.model

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the error (k,)."""
        return np.sqrt((self.error**2).mean(axis=0))


def commands_of(flight: Flight) -> str:
    """The vehicle model of a flight's commands, "motor" or "rate"; "" for others."""
    command = flight.signals.get("command")
    if command is None or "actuators" not in flight.signals:
        return ""
    return MODELS.get(str(command.by_unit()[0].unit), "")


def response(flight: Flight, constants: Mapping[str, float]) -> Response:
    """Propeller speeds, or body rates, with their commands.

    Args:
        flight: with commands.
        constants: of the model of its commands, motor or rate: time constants and limits.
    """
    if commands_of(flight) == "motor":
        signal, command, tau = flight.signals["actuators"], flight["command"], constants["tau"]
        low, high = (np.full(4, constants[f"rpm_{end}"]) for end in ("min", "max"))
    else:
        signal, command = flight.signals["rates"], flight["command"][:, :3]
        tau, high = constants["tau_rate"], np.array([constants[f"{axis}_max"] for axis in "pqr"])
        low = -high
    step = float(np.median(np.diff(flight.time)))
    model = first_order(np.clip(command, low, high), signal.values[0], tau, step)
    return Response(signal.values, command, model, low, high, signal.labels, str(signal.unit))


def error_figure(flight: Flight, found: Response, gates: int, title: str = "") -> Figure:
    """The signals with their limits and the errors of a flight over time, a row for each signal.

    Args:
        flight: the flight.
        found: of ``response``.
        gates: of the track: passages are marked, the ends of laps by darker lines.
        title: of the figure.
    """
    figure = new_figure(9.6, 0.9 + 1.25 * len(found.names))
    grid = figure.subplots(len(found.names), 2, sharex=True, sharey="col")
    time, colors = flight.time, matplotlib.colormaps["viridis"]([0.1, 0.55, 0.75])
    for index, (left, right) in enumerate(grid):
        left.plot(time, found.command[:, index], color=MUTED, lw=0.6, label="commanded")
        model, actual = found.model[:, index], found.actual[:, index]
        left.plot(time, model, color=colors[2], lw=1.3, label="first-order response")
        left.plot(time, actual, color=colors[0], lw=1.0, label="measured")
        for limit in (found.low[index], found.high[index]):
            left.axhline(limit, color=INK, lw=0.9, ls=":", label="limits" if limit > 0 else None)
        right.plot(time, found.error[:, index], color=colors[0], lw=0.9)
        right.axhline(0.0, color=INK, lw=0.8)
        for axes in (left, right):
            tidy(axes)
            axes.tick_params(labelsize=8)
            axes.set_xlim(time[0], time[-1])
            for number, passed in enumerate(gate_times(flight), start=1):
                low = 0.0 if number % gates == 0 else 0.94
                axes.axvline(passed, ymin=low, color=MUTED, lw=0.8, zorder=0)
        left.set_ylabel(f"{found.names[index]}\n({found.unit})", color=INK, fontsize=8)
        text = f"RMS {found.rms[index]:.3g} {found.unit}"
        right.set_title(text, loc="right", fontsize=8, color=INK, pad=2)
    small = {"fontsize": 8, "color": INK, "pad": 2}
    grid[0, 1].set_title("error to the first-order response", loc="left", **small)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)", color=INK)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    first = {label: handle for handle, label in zip(handles, labels, strict=True)}
    figure.legend(
        first.values(),
        first,
        loc="outside upper left",
        ncols=4,
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        title=f"{title or flight.name}; ticks: gates, lines: laps",
        title_fontsize=9,
        alignment="left",
    )
    return figure
