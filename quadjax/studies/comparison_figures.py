"""Figures of the comparison: progress, and flights against the first-order training models."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, SERIES, head, new_figure, tidy
from quadjax.fitting.signals import first_order
from quadjax.plant.flights import Flights, rows
from quadjax.race.laps import Trace

SECONDS = 3.0  # of a flight in a figure of signals


def progress(position: np.ndarray, target: np.ndarray, gates: np.ndarray) -> np.ndarray:
    """Progress (n,) along the track, laps: gates passed plus the fraction of the way to the next.

    Args:
        position: (n, 3) m, world.
        target: (n,) index of the gate ahead.
        gates: (gates, 3) centers, m, world.
    """
    legs = np.linalg.norm(gates - np.roll(gates, 1, axis=0), axis=1)
    passed = np.concatenate([[0], np.cumsum(np.diff(target) != 0)])
    left = np.linalg.norm(position - gates[target], axis=1) / legs[target]
    return (passed + np.clip(1.0 - left, 0.0, 1.0)) / len(gates)


def plant_progress(flights: Flights, run: int, gates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and progress, laps, of a recorded run on the plant."""
    frames = flights.frames
    target = np.asarray(frames.target)[~frames.over[:, run], run]
    made = progress(rows(flights, frames.true.position, run), target, gates)
    return flights.step * np.arange(len(made)), made


def simulated_progress(
    trace: Trace, run: int, dt: float, gates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same of a run in the simulator."""
    going = ~np.asarray(trace.over)[:, run]
    position = np.asarray(trace.position, np.float64)[going, :, run]
    made = progress(position, np.asarray(trace.target)[going, run], gates)
    return dt * np.arange(len(made)), made


def progress_figure(
    lines: dict[str, tuple[np.ndarray, np.ndarray]], pace: float, title: str
) -> Figure:
    """Progress relative to a constant pace over time.

    Args:
        lines: times, s, and progress, laps, by label.
        pace: of the reference, laps per second.
        title: over the picture.
    """
    figure = new_figure(9.0, 4.6)
    axes = figure.add_subplot()
    tidy(axes)
    for index, (label, (time, made)) in enumerate(lines.items()):
        style = "--" if "simulat" in label else "-"
        color = SERIES[(index // 2) % len(SERIES)]
        axes.plot(time, made - pace * time, style, color=color, lw=1.4, label=label)
    axes.set_xlabel("time (s)", color=INK)
    axes.set_ylabel(f"laps ahead of one in {1.0 / pace:.2f} s", color=INK)
    head(axes, title)
    return figure


def rpm_figure(flights: Flights, tau: float, run: int = 0) -> tuple[Figure, np.ndarray]:
    """Propeller speeds of a run against the first-order model of their commands.

    Returns:
        The figure, and the root mean square deviation of each motor, rpm, (4,).
    """
    frames, dt = flights.frames, flights.step
    command = rows(flights, frames.rpm_command, run)
    true = rows(flights, frames.true.rpm, run)
    model = first_order(command, true[0], tau, dt)
    names = ["1 front left", "2 front right", "3 rear right", "4 rear left"]
    figure = _panels(dt, command, true, model, names, "rpm", "propeller speeds on the plant")
    return figure, np.sqrt(((true - model) ** 2).mean(axis=0))


def rates_figure(
    flights: Flights, taus: Sequence[float], run: int = 0
) -> tuple[Figure, np.ndarray]:
    """Body rates and specific thrust of an INDI run against the first-order model.

    Returns:
        The figure, and the root mean square deviation of each, rad/s and m/s^2, (4,).
    """
    frames, dt = flights.frames, flights.step
    command = rows(flights, frames.command, run)
    thrust = -rows(flights, frames.specific_force, run)[:, 2:]
    true = np.concatenate([rows(flights, frames.true.rates, run), thrust], axis=1)
    model = np.concatenate(
        [
            first_order(command[:, i : i + 1], true[0, i : i + 1], tau, dt)
            for i, tau in enumerate(taus)
        ],
        axis=1,
    )
    names = ["p (rad/s)", "q (rad/s)", "r (rad/s)", "thrust (m/s²)"]
    title = "rates and thrust under the inner loop"
    figure = _panels(dt, command, true, model, names, "", title)
    return figure, np.sqrt(((true - model) ** 2).mean(axis=0))


def _panels(
    dt: float,
    command: np.ndarray,
    true: np.ndarray,
    model: np.ndarray,
    names: Sequence[str],
    unit: str,
    title: str,
) -> Figure:
    count = min(len(true), round(SECONDS / dt))
    time = dt * np.arange(count)
    figure = new_figure(9.0, 8.0)
    panels = figure.subplots(len(names), 1, sharex=True)
    for index, (axes, name) in enumerate(zip(panels, names, strict=True)):
        tidy(axes)
        axes.plot(time, command[:count, index], color=MUTED, lw=0.7, label="commanded")
        axes.plot(time, model[:count, index], color=SERIES[1], lw=1.2, label="first-order model")
        axes.plot(time, true[:count, index], color=SERIES[0], lw=1.2, label="plant")
        axes.set_ylabel(f"{name} {unit}".strip(), color=INK, fontsize=9)
    head(panels[0], title)
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure
