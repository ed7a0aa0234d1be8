"""Matplotlib figures of flights in space, with the gates to size; they need not be closed."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from quadjax.core.errors import InputError
from quadjax.core.plotting import INK, MUTED, PAPER, SERIES, SPEED_COLORS, head, new_figure, tidy
from quadjax.evaluation.table import counted
from quadjax.flights.flight import Flight, fastest
from quadjax.race.track import GateSection

Groups = Mapping[str, Sequence[Flight]]
UP = np.array([1.0, 1.0, -1.0])  # NED to north, east, height
ELEVATION, AZIMUTH = 28.0, -62.0  # deg, of the view in perspective
ACROSS = 4  # groups next to each other
MANY = 5  # flights of a group that are all drawn; of more the fastest one
DARKEST, LIGHTEST = 0.0, 0.78  # of the color map: lines that are lighter do not show on white


def colors_of(groups: Mapping[str, object]) -> dict[str, tuple[float, ...]]:
    """A color for each group, evenly spaced in a perceptually uniform map."""
    places = np.linspace(DARKEST, LIGHTEST, max(len(groups), 2))
    return dict(zip(groups, matplotlib.colormaps["viridis"](places).tolist(), strict=False))


def trajectory_figure(
    flights: Groups | Sequence[Flight], gates: Sequence[GateSection], title: str = ""
) -> Figure:
    """Flights from above and from the side, colored by speed, with the gates to size.

    From above: x (north) to the right, y (east) down. From the side: x to the right, height up. The
    scale is the same on all axes. Each group has a column, with the total of its fastest flight,
    which alone is drawn where there are more than ``MANY``.

    Args:
        flights: groups by label, or flights of one group; none draws the track alone.
        gates: of the track, in order of passage.
        title: of a figure of one group.
    """
    groups: Groups = flights if isinstance(flights, Mapping) else {title: flights}
    several = isinstance(flights, Mapping)
    drawn = {label: list(group) for label, group in groups.items()}
    if several:
        drawn = {k: v if len(v) <= MANY else [fastest(v)] for k, v in drawn.items()}
    every = [flight for group in drawn.values() for flight in group]
    lowest, highest = extent(every, gates)
    size, columns = highest - lowest, min(len(drawn), ACROSS)
    blocks = -(-len(drawn) // columns)
    scale = (
        min(8.0 / size[0], 7.0 / (size[1] + size[2])) if columns == 1 else 9.0 / columns / size[0]
    )
    tall = scale * (size[1] + size[2]) + (1.6 if columns == 1 else 0.75)
    figure = new_figure(scale * size[0] * columns + 1.9, tall * blocks)
    ratios = [size[1], size[2]] * blocks
    grid = figure.subplots(
        2 * blocks, columns, sharex=True, sharey="row", height_ratios=ratios, squeeze=False
    )
    for index, (label, group) in enumerate(drawn.items()):
        above, side = grid[2 * (index // columns) : 2 * (index // columns) + 2, index % columns]
        lines = draw_flights(above, side, group, gates, speed_range(every) if every else (0, 1))
        above.set(xlim=(lowest[0], highest[0]), ylim=(highest[1], lowest[1]), aspect="equal")
        side.set(ylim=(lowest[2], highest[2]), aspect="equal")
        side.set_xlabel("x, north (m)", color=INK)
        if several:
            above.set_title(_group_title(label, groups[label]), color=INK, fontsize=10, loc="left")
        else:
            number_gates(above, side, gates, 0.055 * float(size.max()))
            _draw_ends(above, group)
            head(above, label)
    for axes in grid.flat:
        tidy(axes)
        axes.set_visible(axes.has_data())
    for block in range(blocks):
        grid[2 * block, 0].set_ylabel("y, east (m)", color=INK)
        grid[2 * block + 1, 0].set_ylabel("height (m)", color=INK)
    if lines is not None:
        speed_bar(figure, lines, grid)
    return figure


def draw_flights(
    above: Axes,
    side: Axes,
    flights: Sequence[Flight],
    gates: Sequence[GateSection],
    speeds: tuple[float, float],
) -> LineCollection | None:
    """Draw flights and gates from above and from the side; returns the lines of one flight."""
    lines, width = None, 2.2 if len(flights) == 1 else 1.3
    for flight in flights:
        points = flight["position"] * UP
        lines = speed_line(above, points[:, :2], flight.speed, speeds, width)
        speed_line(side, points[:, [0, 2]], flight.speed, speeds, width)
    low, high = extent(flights, gates)
    for gate in gates:
        draw_gate(above, gate, 0.055 * float((high - low).max()))
        draw_gate_from_side(side, gate)
    side.axhline(0.0, color=MUTED, linewidth=1.5)
    return lines


def speed_bar(figure: Figure, lines: Any, axes: Any, **style: Any) -> None:
    """The scale of the colors of lines."""
    bar = figure.colorbar(lines, ax=axes, extend="min", **({"pad": 0.02, "aspect": 28} | style))
    bar.set_label("speed (m/s)", color=INK)
    bar.outline.set_visible(False)


def _group_title(label: str, flights: Sequence[Flight]) -> str:
    best = fastest(flights)
    if not np.isfinite(best.total):
        return f"{label}\n{best.crash or 'unfinished'} in lap {len(best.lap_times) + 1}"
    note = f"{best.total:.2f} s, {counted(len(best.lap_times), 'lap')}"
    return f"{label}\n{note}" + (f", fastest of {len(flights)}" if len(flights) > 1 else "")


def extent(
    flights: Sequence[Flight], gates: Sequence[GateSection]
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x, y and height of all that is drawn, with a margin, m."""
    points = [flight["position"] for flight in flights]
    for gate in gates:
        reach = 0.5 * np.array([gate.size[0], gate.size[0], gate.size[1]])
        points.append(np.array([gate.position]) + np.array([[-1.0], [1.0]]) * reach)
    every = np.concatenate(points) * UP
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
    axes: Axes, points: np.ndarray, speed: np.ndarray, limits: tuple[float, float], width: float
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
    lines.set_clim(*limits)
    axes.add_collection(lines)
    return lines


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
    differ = float(np.ptp([gate.position[2] for gate in gates])) > 0.05
    return numbers, f"{heights} m" if differ else ""


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
        numbers, place = gate_labels(gates, group)[0], tuple(tops[group[0]])
        side.annotate(numbers, place, xytext=(0, 7), color=MUTED, fontsize=8, **style)


def gate_outline(gate: GateSection) -> np.ndarray:
    """The closed outline (n, 3) of a gate's opening, m, world: four corners, or a circle."""
    _, right, down = np.array(gate.axes).T
    if gate.shape == "rectangle":
        across, along = 0.5 * np.array(gate.size)
        corners = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
        shifts = [x * across * right + y * along * down for x, y in corners]
        return np.array(gate.position) + np.array(shifts)
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:, None]
    rim = np.cos(turn) * right + np.sin(turn) * down
    return np.array(gate.position) + 0.5 * gate.size[0] * rim


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
    arrow = f"-|>,head_width={0.28 * scale},head_length={0.5 * scale}"
    style = {"arrowstyle": arrow, "color": INK, "lw": 1.8 * scale}
    tip, tail = tuple(center + reach * ahead), tuple(center)
    axes.annotate("", xy=tip, xytext=tail, arrowprops=style, zorder=5)


def _draw_ends(axes: Axes, flights: Sequence[Flight]) -> None:
    if not flights:
        return
    starts = np.array([flight["position"][0, :2] for flight in flights])
    style: dict[str, Any] = {"linestyle": "none", "zorder": 7}
    ring: dict[str, Any] = {
        "markerfacecolor": PAPER,
        "markeredgecolor": INK,
        "markeredgewidth": 1.8,
    }
    axes.plot(*starts.T, "o", markersize=9, label="start", **ring, **style)
    crashed = np.array([flight["position"][-1, :2] for flight in flights if flight.crash])
    if crashed.size:
        cross: dict[str, Any] = {"color": SERIES[1], "markeredgecolor": PAPER}
        axes.plot(*crashed.T, "X", markersize=11, label="crash", **cross, **style)


def space_figure(
    flights: Sequence[Flight], gates: Sequence[GateSection], title: str = ""
) -> Figure:
    """Flights in perspective, colored by speed, with their shadows and the gates to size.

    Args:
        flights: one or more.
        gates: of the track, in order of passage.
        title: of the figure.

    Raises:
        InputError: no flight.
    """
    if not flights:
        raise InputError("no flight to draw")
    figure = new_figure(9.0, 6.0)
    axes = figure.add_subplot(projection="3d")
    for flight in flights:
        points = flight["position"] * UP
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        lines = Line3DCollection(list(pieces), cmap=SPEED_COLORS, linewidths=1.8)
        lines.set_array(0.5 * (flight.speed[:-1] + flight.speed[1:]))
        lines.set_clim(*speed_range(flights))
        axes.add_collection3d(lines)
        axes.plot(*points[:, :2].T, 0.0, color=MUTED, lw=0.8, alpha=0.5)
    for index, gate in enumerate(gates):
        outline = gate_outline(gate) * UP
        axes.plot(*outline.T, color=INK, lw=2.2)
        axes.text(*outline[outline[:, 2].argmax()], f" {index + 1}", color=INK, fontsize=9)
    every = [flight["position"] for flight in flights] + [gate_outline(gate) for gate in gates]
    points = np.concatenate(every) * UP
    lowest, highest = points.min(axis=0) - 0.3, points.max(axis=0) + 0.3
    lowest[2] = 0.0
    axes.set(xlim=(lowest[0], highest[0]), ylim=(highest[1], lowest[1]), zlim=(0.0, highest[2]))
    axes.set_box_aspect(highest - lowest, zoom=1.1)
    axes.zaxis.set_major_locator(MaxNLocator(4))
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set_xlabel("x, north (m)", color=INK)
    axes.set_ylabel("y, east (m)", color=INK)
    axes.set_zlabel("height (m)", color=INK)
    axes.set_title(title, color=INK, fontsize=13, loc="left")
    speed_bar(figure, lines, axes, shrink=0.7, pad=0.1, aspect=20)
    return figure
