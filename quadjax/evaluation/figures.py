"""Matplotlib figures of flights; they need not be closed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, PAPER, SERIES, SPEED_COLORS, head, new_figure, tidy
from quadjax.evaluation.scene import gate_outline
from quadjax.evaluation.tables import counted
from quadjax.flights.flight import Flight
from quadjax.race.track import GateSection

MOTORS = ("1 front left", "2 front right", "3 rear right", "4 rear left")


def trajectory_figure(
    flights: Sequence[Flight], gates: Sequence[GateSection], title: str = ""
) -> Figure:
    """Flights seen from above and from the side, colored by speed, with the gates to size.

    From above: x (north) to the right, y (east) down. From the side: x to the right, height up. The
    scale is the same on all axes.

    Args:
        flights: none draws the track alone.
        gates: of the track, in order of passage.
        title: of the figure.
    """
    lowest, highest = extent(flights, gates)
    size = highest - lowest
    scale = min(8.0 / size[0], 7.0 / (size[1] + size[2]))
    figure = new_figure(scale * size[0] + 1.9, scale * (size[1] + size[2]) + 1.6)
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=[size[1], size[2]])
    for flight in flights:
        shown, width = speed_range(flights), 2.2 if len(flights) == 1 else 1.3
        heights = flight["position"] * np.array([1.0, 1.0, -1.0])
        lines = speed_line(above, heights[:, :2], flight.speed, shown, width)
        speed_line(side, heights[:, [0, 2]], flight.speed, shown, width)
    for gate in gates:
        draw_gate(above, gate, 0.055 * float(size.max()))
        draw_gate_from_side(side, gate)
    number_gates(above, side, gates, 0.055 * float(size.max()))
    side.axhline(0.0, color=MUTED, linewidth=1.5)
    _draw_ends(above, flights)
    above.set(xlim=(lowest[0], highest[0]), ylim=(highest[1], lowest[1]), aspect="equal")
    side.set(ylim=(lowest[2], highest[2]), aspect="equal")
    for axes, label in ((above, "y, east (m)"), (side, "height (m)")):
        tidy(axes)
        axes.set_ylabel(label, color=INK)
    side.set_xlabel("x, north (m)", color=INK)
    head(above, title)
    if flights:
        bar = figure.colorbar(lines, ax=[above, side], pad=0.02, aspect=28, extend="min")
        bar.set_label("speed (m/s)", color=INK)
        bar.outline.set_visible(False)
    return figure


def flight_title(flight: Flight) -> str:
    """Laps, time and crash of a flight as a short text."""
    title = f"{counted(len(flight.lap_ends), 'lap')} in {flight.time[-1]:.2f} s"
    return f"{title}, then {flight.crash}" if flight.crash else title


def extent(
    flights: Sequence[Flight], gates: Sequence[GateSection]
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x, y and height of all that is drawn, with a margin, m."""
    points = [flight["position"] for flight in flights]
    for gate in gates:
        reach = 0.5 * np.array([gate.size[0], gate.size[0], gate.size[1]])
        points.append(np.array([gate.position]) + np.array([[-1.0], [1.0]]) * reach)
    every = np.concatenate(points) * np.array([1.0, 1.0, -1.0])
    room = 0.3 + 0.1 * float(np.ptp(every[:, :2], axis=0).max())  # for the gates' numbers
    margin = np.array([room, room, 0.3])
    lowest, highest = every.min(axis=0) - margin, every.max(axis=0) + margin
    lowest[2] = min(lowest[2], -0.1)  # the ground
    return lowest, highest


def speed_range(flights: Sequence[Flight]) -> tuple[float, float]:
    """Limits of the color scale, m/s; the take-off may be below."""
    speeds = np.concatenate([flight.speed for flight in flights])
    lowest, highest = float(np.quantile(speeds, 0.04)), float(speeds.max())
    return min(lowest, highest - 0.1), highest


def speed_line(
    axes: Axes, points: np.ndarray, speed: np.ndarray, shown: tuple[float, float], width: float
) -> LineCollection:
    """Draw points (n, 2) as a line whose color is the speed (n,), m/s."""
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=SPEED_COLORS,
        linewidths=width,
        capstyle="round",
        zorder=3,
    )
    lines.set_array(0.5 * (speed[:-1] + speed[1:]))
    lines.set_clim(*shown)
    axes.add_collection(lines)
    return lines


def heights_differ(gates: Sequence[GateSection]) -> bool:
    """Whether the gates are at different heights."""
    return float(np.ptp([gate.position[2] for gate in gates])) > 0.05


def same_place(points: np.ndarray, reach: float = 0.3) -> list[list[int]]:
    """Indices of points (n, 2) in groups, each within ``reach``, m, of the group's first."""
    groups: list[list[int]] = []
    for index, point in enumerate(points):
        near = (g for g in groups if np.linalg.norm(points[g[0]] - point) <= reach)
        group = next(near, None)
        if group is None:
            groups.append([index])
        else:
            group.append(index)
    return groups


def label_places(gates: Sequence[GateSection], reach: float) -> np.ndarray:
    """Positions (gates, 2), m, of the gates' labels, seen from above: beyond the outer post."""
    center = np.array([gate.position[:2] for gate in gates])
    yaw = np.radians([gate.yaw_deg for gate in gates])
    right = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    outwards = np.sum((center - center.mean(axis=0)) * right, axis=1) >= 0
    far = 0.5 * np.array([gate.size[0] for gate in gates]) + reach
    return center + np.where(outwards, far, -far)[:, None] * right


def gate_labels(gates: Sequence[GateSection], group: Sequence[int]) -> tuple[str, str]:
    """The numbers of gates, and their heights where those of the track differ."""
    numbers = ", ".join(str(index + 1) for index in group)
    heights = ", ".join(f"{-gates[index].position[2]:.1f}" for index in group)
    return numbers, f"{heights} m" if heights_differ(gates) else ""


def number_gates(above: Axes, side: Axes, gates: Sequence[GateSection], reach: float) -> None:
    """Write numbers and heights next to the gates; gates at the same place share a label."""
    style: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 6}
    style["textcoords"] = "offset points"
    places = label_places(gates, 0.9 * reach)
    for group in same_place(places):
        numbers, heights = gate_labels(gates, group)
        up, place = (5 if heights else 0), tuple(places[group[0]])
        bold: dict[str, Any] = {"color": INK, "fontsize": 11, "fontweight": "bold"}
        above.annotate(numbers, place, xytext=(0, up), **bold, **style)
        above.annotate(heights, place, xytext=(0, -7), color=MUTED, fontsize=8, **style)
    tops = np.array([(g.position[0], -gate_outline(g)[:, 2].min()) for g in gates])
    for group in same_place(tops):
        numbers = gate_labels(gates, group)[0]
        place = tuple(tops[group[0]])
        side.annotate(numbers, place, xytext=(0, 7), color=MUTED, fontsize=8, **style)


def draw_gate_from_side(axes: Axes, gate: GateSection) -> None:
    """Draw the outline of a gate seen from the side."""
    x, _, z = gate_outline(gate).T
    axes.plot(x, -z, color=INK, linewidth=1.8, zorder=2, alpha=0.6)


def draw_gate(axes: Axes, gate: GateSection, reach: float, scale: float = 1.0) -> None:
    """Draw a gate from above: its opening, two posts, an arrow in flight direction."""
    center, yaw = np.array(gate.position[:2]), np.radians(gate.yaw_deg)
    ahead, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    across = 0.5 * gate.size[0] * right
    ends = np.array([center - across, center + across])
    if gate.pitch_deg or gate.roll_deg:
        x, y, _ = gate_outline(gate).T
        axes.plot(x, y, color=INK, linewidth=1.8, zorder=4, alpha=0.6)
    line: dict[str, Any] = {"color": INK, "linewidth": 4.0 * scale, "solid_capstyle": "butt"}
    axes.plot(*ends.T, **line, zorder=4, alpha=0.85)
    axes.plot(*ends.T, "o", color=INK, markersize=7 * scale, zorder=5)
    axes.annotate(
        "",
        xy=tuple(center + reach * ahead),
        xytext=tuple(center),
        arrowprops={
            "arrowstyle": f"-|>,head_width={0.28 * scale},head_length={0.5 * scale}",
            "color": INK,
            "lw": 1.8 * scale,
        },
        zorder=5,
    )


def _draw_ends(axes: Axes, flights: Sequence[Flight]) -> None:
    if not flights:
        return
    starts = np.array([flight["position"][0, :2] for flight in flights])
    axes.plot(
        *starts.T,
        "o",
        markersize=9,
        markerfacecolor=PAPER,
        markeredgecolor=INK,
        markeredgewidth=1.8,
        linestyle="none",
        label="start",
        zorder=7,
    )
    crashed = np.array([flight["position"][-1, :2] for flight in flights if flight.crash])
    if crashed.size:
        axes.plot(
            *crashed.T,
            "X",
            markersize=11,
            color=SERIES[1],
            markeredgecolor=PAPER,
            linestyle="none",
            label="crash",
            zorder=7,
        )


def signals_figure(flight: Flight, title: str = "") -> Figure:
    """Propeller speeds (or thrust) and body rates of a flight over time, with its laps.

    Args:
        flight: one run.
        title: of the figure.
    """
    figure = new_figure(9.0, 5.6)
    above, below = figure.subplots(2, 1, sharex=True)
    actuators, rates = flight["actuators"], flight["rates"]
    if actuators.shape[1] == 4:
        for motor, (name, color) in enumerate(zip(MOTORS, SERIES, strict=True)):
            above.plot(flight.time, actuators[:, motor], color=color, lw=1.1, label=name)
        above.set_ylabel("propeller speed (rpm)", color=INK)
    else:
        thrust, command = actuators[:, 0], flight["command"][:, 3]
        above.plot(flight.time, thrust, color=SERIES[0], lw=1.3, label="thrust")
        above.plot(flight.time, command, color=MUTED, lw=0.8, zorder=1, label="commanded")
        above.set_ylabel("specific thrust (m/s²)", color=INK)
    for axis, name in enumerate(("p, roll", "q, pitch", "r, yaw")):
        below.plot(flight.time, rates[:, axis], color=SERIES[axis], lw=1.2, label=name)
    below.set_ylabel("body rate (rad/s)", color=INK)
    below.set_xlabel("time (s); dashed: a lap's end", color=INK)
    for axes in (above, below):
        tidy(axes)
        axes.margins(x=0.01)
        for end in flight.lap_ends:
            axes.axvline(end, color=MUTED, lw=0.9, ls="--", zorder=0)
    head(above, title)
    head(below)
    return figure
