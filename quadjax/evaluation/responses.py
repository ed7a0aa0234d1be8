"""Commands of a flight next to the first-order response of the drone that flew."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from quadjax.config.schema import Vehicle
from quadjax.core.plotting import INK, MUTED, new_figure, tidy
from quadjax.fitting.signals import first_order
from quadjax.flights.flight import Flight
from quadjax.vehicle.registry import base_model

SHADES = [0.1, 0.55, 0.75]  # of measured, marks and model in a color map


POINTS = 4000  # samples of a signal in a figure, about


MODELS = {"rpm": "motor", "rad/s": "rate"}  # vehicle model by the unit of the commands


@dataclasses.dataclass(frozen=True)
class Response:
    """Commands of a flight, their limits, and measured and modeled values."""

    actual: np.ndarray  # (n, k)
    command: np.ndarray  # (n, k)
    model: np.ndarray  # (n, k), such as the first-order response to the commands
    low: np.ndarray  # (k,)
    high: np.ndarray  # (k,)
    names: Sequence[str]
    units: Sequence[str]  # of each
    labels: tuple[str, str, str] = ("commanded", "first-order response", "measured")

    @property
    def error(self) -> np.ndarray:
        """The difference from the model, (n, k)."""
        return self.actual - self.model

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the error (k,)."""
        return np.sqrt((self.error**2).mean(axis=0))


def response(flight: Flight, vehicle: Vehicle) -> Response | None:
    """Propeller speeds, or body rates and specific thrust, with their commands.

    The limits and lags are those of the drone that flew, where the flight has its constants, or
    else those of ``vehicle``. None for a flight without such commands, or if there are no constants
    of its model.
    """
    commands = flight.signals.get("command")
    kind = "" if commands is None else MODELS.get(str(commands.by_unit()[0].unit), "")
    vehicle = _drone_of(flight, vehicle)
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
    actual = np.concatenate([signal.values for signal in parts], axis=1)
    names = [label for signal in parts for label in signal.labels]
    units = [str(signal.unit) for signal in parts for _ in range(signal.values.shape[1])]
    lag = np.concatenate(
        [[tau] * signal.values.shape[1] for signal, tau in zip(parts, lags, strict=False)]
    )
    clipped = np.clip(command, low, high)
    model = np.stack(
        [first_order(clipped[:, i], actual[0, i], lag[i], step) for i in range(len(lag))], axis=1
    )
    return Response(actual, command, model, low, high, names, units)


def _drone_of(flight: Flight, vehicle: Vehicle) -> Vehicle:
    """The vehicle that flew, if the flight has all constants of a model; else another one."""
    model, constants = (flight.source.get(key) for key in ("vehicle", "constants"))
    if not isinstance(constants, dict) or model not in MODELS.values():
        return vehicle
    known = set(constants) == set(base_model(str(model)).constant_names)
    return Vehicle(model=str(model), constants=constants) if known else vehicle


def error_figure(flight: Flight, signals: Response, gates: int, title: str = "") -> Figure:
    """The signals with their limits and the errors of a flight over time, a row for each signal.

    Passages of the ``gates`` of the track are marked, the ends of laps by darker lines.
    """
    figure, labels = new_figure(9.6, 0.9 + 1.25 * len(signals.names)), signals.labels
    same_unit = len(set(signals.units)) == 1
    share: Literal["col", "none"] = "col" if same_unit else "none"
    grid = figure.subplots(len(signals.names), 2, sharex=True, sharey=share, squeeze=False)
    every, colors = max(1, len(flight.time) // POINTS), matplotlib.colormaps["viridis"](SHADES)
    time, errors = flight.time[::every], signals.error[::every]
    small: dict[str, Any] = {"fontsize": 8, "color": INK}
    for index, (left, right) in enumerate(grid):
        lines, widths = (signals.command, signals.model, signals.actual), (0.6, 1.3, 1.0)
        styles = zip(lines, labels, (MUTED, colors[2], colors[0]), widths, strict=True)
        for values, label, color, width in styles:
            left.plot(time, values[::every, index], color=color, lw=width, label=label)
        left.axhline(signals.high[index], color=INK, lw=0.9, ls=":", label="limits")
        left.axhline(signals.low[index], color=INK, lw=0.9, ls=":")
        right.plot(time, errors[:, index], color=colors[0], lw=0.9)
        right.axhline(0.0, color=INK, lw=0.8)
        for axes in (left, right):
            tidy(axes)
            axes.tick_params(labelsize=8)
            axes.set_xlim(time[0], time[-1])
            for number, passed in enumerate(flight.passages[:, 0], start=1):
                low = 0.0 if number % gates == 0 else 0.94
                axes.axvline(passed, ymin=low, color=MUTED, lw=0.8, zorder=0)
        rms, unit = signals.rms[index], signals.units[index]
        left.set_ylabel(signals.names[index] + (f"\n({unit})" if unit else ""), **small)
        text = f"RMS {rms:.3g} {unit}".rstrip() if np.isfinite(rms) else f"{labels[2]}: no values"
        right.set_title(text, loc="right", pad=2, **small)
    grid[0, 1].set_title(f"{labels[2]} minus {labels[1]}", loc="left", pad=2, **small)
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
