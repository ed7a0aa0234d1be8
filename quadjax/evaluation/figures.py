"""Matplotlib figures of flights in space, with the gates to size, and over time.

They need not be closed.
"""

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
from quadjax.flights.flight import ANGLES, RATES, Flight, fastest
from quadjax.race.track import GateSection

Groups = Mapping[str, Sequence[Flight]]
UP = np.array([1.0, 1.0, -1.0])  # NED to north, east, height
ELEVATION_DEG, AZIMUTH_DEG = 28.0, -62.0  # of the view in perspective
GROUPS_PER_ROW = 4  # groups next to each other
MAX_DRAWN_FLIGHTS = 5  # flights of a group that are all drawn; of more the fastest one
DARKEST, LIGHTEST = 0.0, 0.78  # of the color map: lines that are lighter do not show on white
SAME_PLACE_M = 0.3  # between gates that share a label
COMMANDED = "commanded"
ACTUATORS = {"rpm": "propeller speed (rpm)", "m/s^2": "specific thrust (m/s²)"}  # labels by unit
ARROW = 0.055  # length of the arrow of a gate, of the longest side of the figure


def choose_colors(groups: Mapping[str, object]) -> dict[str, tuple[float, ...]]:
    """A color for each group, evenly spaced in a perceptually uniform map."""
    places = np.linspace(DARKEST, LIGHTEST, max(len(groups), 2))
    return dict(zip(groups, matplotlib.colormaps["viridis"](places).tolist(), strict=False))


def trajectory_figure(
    flights: Groups | Sequence[Flight], gates: Sequence[GateSection], title: str = ""
) -> Figure:
    """Flights from above and from the side, colored by speed, with the gates to size.

    From above: x (north) to the right, y (east) down. From the side: x to the right, height up. The
    scale is the same on all axes. Each group has a column, with the total of its fastest flight,
    which alone is drawn where there are more than ``MAX_DRAWN_FLIGHTS``.

    Args:
        flights: groups by label, or flights of one group; none draws the track alone.
        gates: of the track, in order of passage.
        title: of a figure of one group.
    """
    several = isinstance(flights, Mapping)
    groups: Groups = flights if isinstance(flights, Mapping) else {title: flights}
    selected = {
        k: v if len(v) <= MAX_DRAWN_FLIGHTS or not several else [fastest(v)]
        for k, v in groups.items()
    }
    every = [flight for group in selected.values() for flight in group]
    limits = _extent(every, gates)
    size, columns = limits[1] - limits[0], min(len(selected), GROUPS_PER_ROW)
    alone, blocks = columns == 1, -(-len(selected) // columns)
    scale = min(8.0 / size[0], 7.0 / (size[1] + size[2])) if alone else 9.0 / columns / size[0]
    tall = scale * (size[1] + size[2]) + (1.6 if alone else 0.75)
    figure = new_figure(scale * size[0] * columns + 1.9, tall * blocks)
    ratios = [size[1], size[2]] * blocks
    grid = figure.subplots(
        2 * blocks, columns, sharex=True, sharey="row", height_ratios=ratios, squeeze=False
    )
    speeds, lines = speed_range(every) if every else (0.0, 1.0), None
    for index, (label, group) in enumerate(selected.items()):
        above, side = grid[2 * (index // columns) : 2 * (index // columns) + 2, index % columns]
        for flight in group:
            points, width = flight["position"] * UP, 2.2 if len(group) == 1 else 1.3
            for axes, place in ((above, points[:, :2]), (side, points[:, [0, 2]])):
                lines = axes.add_collection(_speed_line(LineCollection, place, flight, speeds))
                lines.set(linewidth=width, capstyle="round", zorder=3)
        _draw_track(above, side, gates, limits, not several)
        if several:
            above.set_title(_group_title(label, groups[label]), color=INK, fontsize=10, loc="left")
        else:
            _draw_ends(above, group)
            head(above, label)
    for axes in grid.flat:
        tidy(axes)
        axes.set_visible(axes.has_data())
    for block in range(blocks):
        grid[2 * block, 0].set_ylabel("y, east (m)", color=INK)
        grid[2 * block + 1, 0].set_ylabel("height (m)", color=INK)
    if lines is not None:
        _speed_bar(figure, lines, grid)
    return figure


def space_figure(
    flights: Sequence[Flight], gates: Sequence[GateSection], title: str = ""
) -> Figure:
    """Flights in perspective, colored by speed, with their shadows and the gates to size.

    Raises:
        InputError: no flight.
    """
    if not flights:
        raise InputError("no flight to draw")
    figure = new_figure(9.0, 6.0)
    axes: Any = figure.add_subplot(projection="3d")
    for flight in flights:
        points = flight["position"] * UP
        lines = _speed_line(Line3DCollection, points, flight, speed_range(flights))
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
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)
    axes.set_xlabel("x, north (m)", color=INK)
    axes.set_ylabel("y, east (m)", color=INK)
    axes.set_zlabel("height (m)", color=INK)
    axes.set_title(title, color=INK, fontsize=13, loc="left")
    _speed_bar(figure, lines, axes, shrink=0.7, pad=0.1, aspect=20)
    return figure


def signals_figure(flight: Flight, title: str = "") -> Figure:
    """Height, speed, attitude, body rates and actuators of a flight over time, with its laps."""
    actuators = flight.signals["actuators"]
    labels = actuators.labels or [str(i + 1) for i in range(actuators.values.shape[1])]
    outputs = dict(zip(labels, actuators.values.T, strict=True))
    if len(outputs) == 1:
        outputs[COMMANDED] = flight["command"][:, 3]
    angles = (np.degrees(flight["attitude"]) + 180.0) % 360.0 - 180.0
    jumps = np.abs(np.diff(angles, axis=0, prepend=angles[:1])) > 180.0  # from 180 to -180
    angles = np.where(jumps, np.nan, angles).T
    panels: dict[str, dict[str, np.ndarray]] = {
        "height (m)": {"": -flight["position"][:, 2]},
        "speed (m/s)": {"": flight.speed},
        "attitude (deg)": dict(zip(ANGLES, angles, strict=True)),
        "body rate (rad/s)": dict(zip(RATES, flight["rates"].T, strict=True)),
        ACTUATORS.get(str(actuators.unit), f"actuators ({actuators.unit})"): outputs,
    }
    figure = new_figure(9.0, 10.0)
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


def speed_range(flights: Sequence[Flight]) -> tuple[float, float]:
    """Limits of the color scale, m/s; the take-off may be below."""
    speeds = np.concatenate([flight.speed for flight in flights])
    lowest, highest = float(np.quantile(speeds, 0.04)), float(speeds.max())
    return min(lowest, highest - 0.1), highest


def _speed_line(
    kind: type[Any], points: np.ndarray, flight: Flight, limits: tuple[float, float]
) -> Any:
    """Points (n, k) as a line whose color is the speed of the flight."""
    pieces = list(np.stack([points[:-1], points[1:]], axis=1))
    lines = kind(pieces, cmap=SPEED_COLORS, linewidths=1.8)
    lines.set_array(0.5 * (flight.speed[:-1] + flight.speed[1:]))
    lines.set_clim(*limits)
    return lines


def _speed_bar(figure: Figure, lines: Any, axes: Any, **style: Any) -> None:
    bar = figure.colorbar(lines, ax=axes, extend="min", **({"pad": 0.02, "aspect": 28} | style))
    bar.set_label("speed (m/s)", color=INK)
    bar.outline.set_visible(False)


def _group_title(label: str, flights: Sequence[Flight]) -> str:
    best = fastest(flights)
    if not np.isfinite(best.total):
        return f"{label}\n{best.crash or 'unfinished'} in lap {len(best.lap_times) + 1}"
    note = f"{best.total:.2f} s, {counted(len(best.lap_times), 'lap')}"
    return f"{label}\n{note}" + (f", fastest of {len(flights)}" if len(flights) > 1 else "")


def _extent(
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


def _draw_track(
    above: Axes,
    side: Axes,
    gates: Sequence[GateSection],
    limits: tuple[np.ndarray, np.ndarray],
    numbers: bool,
) -> None:
    """Draw the gates from above and from the side, between ``limits`` of ``_extent``.

    ``numbers``: whether the gates have them.
    """
    low, high = limits
    _draw_gates(above, gates, ARROW * float((high - low).max()), numbers)
    for gate in gates:
        x, _, z = gate_outline(gate).T
        side.plot(x, -z, color=INK, linewidth=1.8, zorder=2, alpha=0.6)
    if numbers:
        tops = np.array([(g.position[0], -gate_outline(g)[:, 2].min()) for g in gates])
        names = [str(index + 1) for index in range(len(gates))]
        _label(side, tops, names, 7, color=MUTED, fontsize=8)
    side.axhline(0.0, color=MUTED, linewidth=1.5)
    above.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    side.set(ylim=(low[2], high[2]), aspect="equal")
    side.set_xlabel("x, north (m)", color=INK)


def _draw_gates(above: Axes, gates: Sequence[GateSection], reach: float, numbers: bool) -> None:
    """Draw gates from above: openings, two posts, and arrows of ``reach`` m in flight direction.

    With numbers beyond the outer post, and heights where they differ; gates at the same place share
    a label.
    """
    for gate in gates:
        _draw_gate(above, gate, reach)
    if not numbers:
        return
    center = np.array([gate.position[:2] for gate in gates])
    yaw = np.radians([gate.yaw_deg for gate in gates])
    right = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    outwards = np.sum((center - center.mean(axis=0)) * right, axis=1) >= 0
    far = 0.5 * np.array([gate.size[0] for gate in gates]) + 0.9 * reach
    places = center + np.where(outwards, far, -far)[:, None] * right
    heights = np.array([-gate.position[2] for gate in gates])
    differ = float(np.ptp(heights)) > 0.05
    names = [str(index + 1) for index in range(len(gates))]
    bold: dict[str, Any] = {"color": INK, "fontsize": 11, "fontweight": "bold"}
    _label(above, places, names, 5 if differ else 0, **bold)
    if differ:
        meters = [f"{height:.1f}" for height in heights]
        _label(above, places, meters, -7, " m", color=MUTED, fontsize=8)


def _label(
    axes: Axes, places: np.ndarray, texts: Sequence[str], up: float, unit: str = "", **style: Any
) -> None:
    """Write texts at places (n, 2), ``up`` points higher; those near each other share a label."""
    groups: dict[int, list[str]] = {}
    for point, text in zip(places, texts, strict=True):
        near = np.linalg.norm(places - point, axis=1) <= SAME_PLACE_M
        groups.setdefault(int(near.argmax()), []).append(text)
    for first, group in groups.items():
        label, place = f"{', '.join(group)}{unit}", tuple(places[first])
        more: dict[str, Any] = {"xytext": (0, up), "textcoords": "offset points", "zorder": 6}
        axes.annotate(label, place, ha="center", va="center", **more, **style)


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


def _draw_gate(axes: Axes, gate: GateSection, reach: float) -> None:
    center, yaw = np.array(gate.position[:2]), np.radians(gate.yaw_deg)
    ahead, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    across = 0.5 * gate.size[0] * right
    ends = np.array([center - across, center + across])
    if gate.pitch_deg or gate.roll_deg:
        x, y, _ = gate_outline(gate).T
        axes.plot(x, y, color=INK, linewidth=1.8, zorder=4, alpha=0.6)
    axes.plot(*ends.T, color=INK, linewidth=4.0, solid_capstyle="butt", zorder=4, alpha=0.85)
    axes.plot(*ends.T, "o", color=INK, markersize=7, zorder=5)
    style = {"arrowstyle": "-|>,head_width=0.28,head_length=0.5", "color": INK, "lw": 1.8}
    tip, tail = tuple(center + reach * ahead), tuple(center)
    axes.annotate("", xy=tip, xytext=tail, arrowprops=style, zorder=5)


def _draw_ends(axes: Axes, flights: Sequence[Flight]) -> None:
    style: dict[str, Any] = {"linestyle": "none", "zorder": 7}
    starts = [flight["position"][0, :2] for flight in flights]
    if starts:
        ring: dict[str, Any] = {"mfc": PAPER, "mec": INK, "mew": 1.8}
        axes.plot(*np.transpose(starts), "o", markersize=9, label="start", **ring, **style)
    if crashed := [flight["position"][-1, :2] for flight in flights if flight.crash]:
        cross: dict[str, Any] = {"color": SERIES[1], "mec": PAPER}
        axes.plot(*np.transpose(crashed), "X", markersize=11, label="crash", **cross, **style)
