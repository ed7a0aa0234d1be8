"""Matplotlib figures of flights over time, of lap times, and of gaps between flights."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.config.schema import Vehicle
from quadjax.core.plotting import INK, MUTED, PAPER, SERIES, head, new_figure, tidy
from quadjax.evaluation.figures import MANY, Groups, colors_of
from quadjax.evaluation.table import counted
from quadjax.fitting.signals import first_order
from quadjax.flights.flight import RATES, Flight

STYLES = ("-", "--", "-.", ":")
MODELS = {"rpm": "motor", "rad/s": "rate"}  # vehicle model by the unit of the commands
COMMANDED = "commanded"
ACTUATORS = {"rpm": "propeller speed (rpm)", "m/s^2": "specific thrust (m/s²)"}  # labels by unit


def signals_figure(flight: Flight, title: str = "") -> Figure:
    """Actuators and body rates of a flight over time, with the commanded thrust and its laps."""
    actuators = flight.signals["actuators"]
    labels = actuators.labels or [str(i + 1) for i in range(actuators.values.shape[1])]
    above = dict(zip(labels, actuators.values.T, strict=True))
    if len(above) == 1:
        above[COMMANDED] = flight["command"][:, 3]
    label = ACTUATORS.get(str(actuators.unit), f"actuators ({actuators.unit})")
    rates = dict(zip(RATES, flight["rates"].T, strict=True))
    return _over_time(flight, title, {label: above, "body rate (rad/s)": rates})


def attitude_figure(flight: Flight, title: str = "") -> Figure:
    """Height, speed, roll, pitch and yaw of a flight over time, with its laps."""
    angles = np.degrees(np.unwrap(flight["attitude"], axis=0)).T
    labels = ("height (m)", "speed (m/s)", "roll (deg)", "pitch (deg)", "yaw (deg)")
    values = (-flight["position"][:, 2], flight.speed, *angles)
    panels = {label: {"": line} for label, line in zip(labels, values, strict=True)}
    return _over_time(flight, title, panels)


def _over_time(
    flight: Flight, title: str, panels: Mapping[str, Mapping[str, np.ndarray]]
) -> Figure:
    """Lines (n,) by name in panels by label."""
    figure = new_figure(9.0, 4.0 + 0.8 * len(panels))
    grid = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, lines) in zip(grid, panels.items(), strict=True):
        tidy(axes)
        axes.margins(x=0.01)
        for (name, values), color in zip(lines.items(), (*SERIES, MUTED), strict=False):
            behind = {"color": MUTED, "lw": 0.8, "zorder": 1} if name == COMMANDED else {}
            axes.plot(flight.time, values, label=name, **({"color": color, "lw": 1.2} | behind))
        for end in flight.lap_ends:
            axes.axvline(end, color=MUTED, lw=0.9, ls="--", zorder=0)
        axes.set_ylabel(label, color=INK)
        head(axes, title if axes is grid[0] else "")
    grid[-1].set_xlabel("time (s); dashed: a lap's end", color=INK)
    return figure


def box_figure(groups: Groups) -> Figure:
    """Box plots of lap 1, of the laps after it and of the total, a box for each group.

    Boxes from the first to the third quartile with the median, whiskers to the last flight within
    1.5 times their range, and a dot for each flight. Flights that did not finish count in the laps
    that they completed.
    """
    colors = colors_of(groups)
    figure = new_figure(9.6, 1.1 + 0.5 * len(groups))
    count = max(len(f.lap_times) for flights in groups.values() for f in flights)
    later = f"laps 2 to {count} (s)" if count > 2 else "lap 2 (s)"
    labels = ("lap 1 (s)", later, f"total of {counted(count, 'lap')} (s)")
    panels = figure.subplots(1, 3, sharey=True)
    for place, (group, flights) in enumerate(groups.items()):
        laps = [flight.lap_times for flight in flights]
        totals = [[flight.total] for flight in flights if len(flight.lap_times) == count]
        columns: tuple[list[Any], ...] = ([x[:1] for x in laps], [x[1:] for x in laps], totals)
        for axes, times in zip(panels, columns, strict=True):
            _box(axes, np.concatenate([np.zeros(0), *times]), place, colors[group])
    for axes, label in zip(panels, labels, strict=True):
        tidy(axes)
        axes.grid(False, axis="y")
        axes.set_xlabel(label, color=INK)
        axes.margins(x=0.08)
    panels[0].set_yticks(range(len(groups)), list(groups))
    panels[0].set_ylim(len(groups) - 0.4, -0.6)
    return figure


def _box(axes: Axes, values: np.ndarray, place: int, color: Sequence[float]) -> None:
    times, line = values[np.isfinite(values)], {"color": color, "lw": 1.4}
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
    jitter = 0.12 * np.sin(2.4 * np.arange(times.size))  # so that equal times do not cover
    axes.plot(times, place + jitter, "o", ms=3, color=color, alpha=0.6, mec="none", zorder=3)


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
    every = [flight.passages[:, 0] for flights in groups.values() for flight in flights]
    count = max(map(len, every))
    leader = np.min([times for times in every if len(times) == count], axis=0)
    for index, (group, flights) in enumerate(groups.items()):
        few = len(flights) <= MANY
        style: dict[str, Any] = {"color": colors[group], "lw": 1.8 if few else 0.8}
        style |= {"alpha": 1.0 if few else 0.5}
        line = STYLES[index % len(STYLES)] if len(flights) == 1 else "-"
        for number, flight in enumerate(flights):
            behind = flight.passages[:, 0] - leader[: len(flight.passages)]
            label = f"{group} ({counted(len(flights), 'flight')})" if number == 0 else None
            axes.plot(np.arange(len(behind)) + 1, behind, line, label=label, **style)
            if flight.crash and len(behind):
                axes.plot(len(behind), behind[-1], "x", color=colors[group], ms=8, mew=2)
    for lap in range(gates, count + 1, gates):
        axes.axvline(lap, color=MUTED, lw=0.9, ls="--", zorder=0)
    axes.set_xlim(1, count + 0.15)
    ahead = any(np.any(times < leader[: len(times)]) for times in every)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]) if ahead else 0.0)
    axes.set_xlabel("gate; dashed: the end of a lap", color=INK)
    axes.set_ylabel("behind the first at each gate (s)", color=INK)
    figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, fontsize=9)
    return figure


@dataclasses.dataclass(frozen=True)
class Response:
    """A flight's commanded signals, their limits and the model's response to the commands."""

    actual: np.ndarray  # (n, k)
    command: np.ndarray  # (n, k)
    model: np.ndarray  # (n, k) first-order response to the commands
    low: np.ndarray  # (k,)
    high: np.ndarray  # (k,)
    names: Sequence[str]
    units: Sequence[str]  # of each

    @property
    def error(self) -> np.ndarray:
        """The difference from the model's response, (n, k)."""
        return self.actual - self.model

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the error (k,)."""
        return np.sqrt((self.error**2).mean(axis=0))


def response(flight: Flight, vehicle: Vehicle) -> Response | None:
    """Propeller speeds, or body rates and specific thrust, with their commands.

    None for a flight without such commands, or whose model the vehicle has no constants of.
    """
    commands = flight.signals.get("command")
    kind = "" if commands is None else MODELS.get(str(commands.by_unit()[0].unit), "")
    if kind not in (vehicle.model, *vehicle.models) or "actuators" not in flight.signals:
        return None
    constants = vehicle.with_model(kind).constants
    command, step = flight["command"], float(np.median(np.diff(flight.time)))
    if kind == "motor":
        parts, lags = [flight.signals["actuators"]], [constants["tau"]]
        low, high = (np.full(4, constants[f"rpm_{end}"]) for end in ("min", "max"))
    else:
        parts = [flight.signals["rates"], flight.signals["actuators"]]
        lags = [constants["tau_rate"], constants["tau_thrust"]]
        rates = np.array([constants[f"{axis}_max"] for axis in "pqr"])
        low = np.append(-rates, constants["thrust_min"])
        high = np.append(rates, constants["thrust_max"])
        if parts[1].values.shape[1] != 1:  # rotor speeds of a log, and no thrust
            parts, low, high, command = parts[:1], low[:3], high[:3], command[:, :3]
    actual = np.concatenate([part.values for part in parts], axis=1)
    names = [label for part in parts for label in part.labels]
    units = [str(part.unit) for part in parts for _ in range(part.values.shape[1])]
    lag = np.concatenate(
        [[tau] * part.values.shape[1] for part, tau in zip(parts, lags, strict=False)]
    )
    wanted = np.clip(command, low, high)
    model = np.stack(
        [first_order(wanted[:, i], actual[0, i], lag[i], step) for i in range(len(lag))], axis=1
    )
    return Response(actual, command, model, low, high, names, units)


def error_figure(flight: Flight, signals: Response, gates: int, title: str = "") -> Figure:
    """The signals with their limits and the errors of a flight over time, a row for each signal.

    Args:
        flight: the flight.
        signals: of ``response``.
        gates: of the track: passages are marked, the ends of laps by darker lines.
        title: of the figure.
    """
    figure = new_figure(9.6, 0.9 + 1.25 * len(signals.names))
    same_unit = len(set(signals.units)) == 1
    grid = figure.subplots(len(signals.names), 2, sharex=True, sharey="col" if same_unit else False)
    time, colors = flight.time, matplotlib.colormaps["viridis"]([0.1, 0.55, 0.75])
    small: dict[str, Any] = {"fontsize": 8, "color": INK}
    for index, (left, right) in enumerate(grid):
        left.plot(time, signals.command[:, index], color=MUTED, lw=0.6, label="commanded")
        model, actual = signals.model[:, index], signals.actual[:, index]
        left.plot(time, model, color=colors[2], lw=1.3, label="first-order response")
        left.plot(time, actual, color=colors[0], lw=1.0, label="measured")
        left.axhline(signals.high[index], color=INK, lw=0.9, ls=":", label="limits")
        left.axhline(signals.low[index], color=INK, lw=0.9, ls=":")
        right.plot(time, signals.error[:, index], color=colors[0], lw=0.9)
        right.axhline(0.0, color=INK, lw=0.8)
        for axes in (left, right):
            tidy(axes)
            axes.tick_params(labelsize=8)
            axes.set_xlim(time[0], time[-1])
            for number, passed in enumerate(flight.passages[:, 0], start=1):
                low = 0.0 if number % gates == 0 else 0.94
                axes.axvline(passed, ymin=low, color=MUTED, lw=0.8, zorder=0)
        left.set_ylabel(f"{signals.names[index]}\n({signals.units[index]})", **small)
        text = f"RMS {signals.rms[index]:.3g} {signals.units[index]}"
        right.set_title(text, loc="right", pad=2, **small)
    grid[0, 1].set_title("error to the first-order response", loc="left", pad=2, **small)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)", color=INK)
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(),
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
