"""Commanded and measured actuators or body rates of a flight."""

import dataclasses
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, new_figure, tidy
from quadjax.evaluation.figures import MOTORS
from quadjax.fitting.signals import first_order
from quadjax.flights.flight import Flight

RPM, RATES = "rpm", "rates"  # what a flight's commands are
NAMES = {RPM: MOTORS, RATES: ("p, roll", "q, pitch", "r, yaw")}


@dataclasses.dataclass(frozen=True)
class Signals:
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


def commands_of(flight: Flight) -> str:
    """What the commands of a flight are: "rpm", "rates" (and thrust), or "" for others."""
    command = flight.signals.get("command")
    if command is None or "actuators" not in flight.signals:
        return ""
    return {"rpm": RPM, "rad/s": RATES}.get(command.by_unit()[0].unit, "")


def signals_of(flight: Flight, constants: Mapping[str, float]) -> Signals:
    """Propeller speeds, or body rates, with their commands.

    Args:
        flight: with commands.
        constants: of the model of its commands, motor or rate: time constants and limits.
    """
    kind, command = commands_of(flight), flight["command"]
    if kind == RPM:
        actual, tau = flight["actuators"], constants["tau"]
        low, high = (np.full(4, constants[f"rpm_{end}"]) for end in ("min", "max"))
    else:
        actual, command, tau = flight["rates"], command[:, :3], constants["tau_rate"]
        high = np.array([constants[f"{axis}_max"] for axis in "pqr"])
        low = -high
    step = float(np.median(np.diff(flight.time)))
    model = first_order(np.clip(command, low, high), actual[0], tau, step)
    unit = "rpm" if kind == RPM else "rad/s"
    return Signals(actual, command, model, low, high, NAMES[kind], unit)


def error_figure(group: str, flight: Flight, signals: Signals) -> Figure:
    """The signals with their limits and the errors of a flight over time, a row for each signal.

    Args:
        group: label of the flight's group.
        flight: the flight; its passages are marked, the ends of laps by lines.
        signals: of ``signals_of``.
    """
    count = len(signals.names)
    figure = new_figure(9.6, 0.9 + 1.25 * count)
    grid = figure.subplots(count, 2, sharex=True, sharey="col")
    time = flight.time
    colors = matplotlib.colormaps["viridis"]([0.1, 0.55, 0.75])
    for index, (left, right) in enumerate(grid):
        left.plot(time, signals.command[:, index], color=MUTED, lw=0.6, label="commanded")
        left.plot(
            time, signals.model[:, index], color=colors[2], lw=1.3, label="first-order response"
        )
        left.plot(time, signals.actual[:, index], color=colors[0], lw=1.0, label="measured")
        for limit in (signals.low[index], signals.high[index]):
            left.axhline(limit, color=INK, lw=0.9, ls=":", label="limits" if limit > 0 else None)
        right.plot(time, signals.error[:, index], color=colors[0], lw=0.9)
        right.axhline(0.0, color=INK, lw=0.8)
        for axes in (left, right):
            tidy(axes)
            axes.tick_params(labelsize=8)
            axes.set_xlim(time[0], time[-1])
            _mark(axes, flight)
        left.set_ylabel(f"{signals.names[index]}\n({signals.unit})", color=INK, fontsize=8)
        rms = float(np.sqrt(np.mean(signals.error[:, index] ** 2)))
        right.set_title(f"RMS {rms:.3g} {signals.unit}", loc="right", fontsize=8, color=INK, pad=2)
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
        title=f"{group}, {flight.name}; ticks: gates, lines: laps",
        title_fontsize=9,
        alignment="left",
    )
    return figure


def _mark(axes: Axes, flight: Flight) -> None:
    """A tick for each gate passage and a line for each end of a lap."""
    for index, passed in enumerate(flight.passages[:, 0], start=1):
        lap = index % len(flight.gates) == 0
        axes.axvline(passed, ymin=0.0 if lap else 0.94, color=MUTED, lw=0.8, zorder=0)
