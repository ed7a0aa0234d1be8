"""Figures of groups of flights: box plots, gaps to the leader, trajectories."""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, PAPER, new_figure, tidy
from quadjax.evaluation.figures import (
    draw_gate,
    draw_gate_from_side,
    extent,
    speed_line,
)
from quadjax.evaluation.figures import speed_range as range_of
from quadjax.evaluation.tables import counted
from quadjax.flights.flight import Flight, fastest
from quadjax.race.track import GateSection

Groups = Mapping[str, Sequence[Flight]]
COLORS = "viridis"
DARKEST, LIGHTEST = 0.0, 0.78  # of the color map: lines that are lighter do not show on white
STYLES = ("-", "--", "-.", ":")
ACROSS = 4  # groups next to each other


def colors_of(groups: Groups) -> dict[str, tuple[float, ...]]:
    """A color for each group, evenly spaced in a perceptually uniform map."""
    places = np.linspace(DARKEST, LIGHTEST, max(len(groups), 2))
    return dict(zip(groups, matplotlib.colormaps[COLORS](places).tolist(), strict=False))


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
    parts = {
        "lap 1 (s)": lambda f: f.lap_times[:1],
        f"laps 2 to {most} (s)" if most > 2 else "lap 2 (s)": lambda f: f.lap_times[1:],
        f"total of {counted(most, 'lap')} (s)": lambda f: [f.total] * (len(f.lap_times) == most),
    }
    for axes, (label, times_of) in zip(panels, parts.items(), strict=True):
        tidy(axes)
        axes.grid(False, axis="y")
        for place, (group, flights) in enumerate(groups.items()):
            times = np.array([time for flight in flights for time in times_of(flight)], float)
            times = times[np.isfinite(times)]
            _box(axes, times, place, colors[group])
        axes.set_xlabel(label, color=INK)
        axes.margins(x=0.08)
    panels[0].set_yticks(range(len(groups)), list(groups))
    panels[0].set_ylim(len(groups) - 0.4, -0.6)
    return figure


def _box(axes: matplotlib.axes.Axes, times: np.ndarray, place: int, color: Sequence[float]) -> None:
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
    every = [flight.passages[:, 0] for flights in groups.values() for flight in flights]
    most = max(map(len, every))
    leader = np.min([times for times in every if len(times) == most], axis=0)
    for index, (group, flights) in enumerate(groups.items()):
        for number, flight in enumerate(flights):
            behind = flight.passages[:, 0] - leader[: len(flight.passages)]
            style = STYLES[index % len(STYLES)] if len(flights) == 1 else "-"
            axes.plot(
                np.arange(1, len(behind) + 1),
                behind,
                style,
                color=colors[group],
                lw=1.8 if len(flights) <= 5 else 0.8,
                alpha=1.0 if len(flights) <= 5 else 0.5,
                label=f"{group} ({counted(len(flights), 'flight')})" if number == 0 else None,
            )
            if flight.crash and len(behind):
                axes.plot(len(behind), behind[-1], "x", color=colors[group], ms=8, mew=2)
    for lap in range(gates, most + 1, gates):
        axes.axvline(lap, color=MUTED, lw=0.9, ls="--", zorder=0)
    axes.set_xlim(1, most + 0.15)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]) if _ahead(every, leader) else 0.0)
    axes.set_xlabel("gate; dashed: the end of a lap", color=INK)
    axes.set_ylabel("behind the first at each gate (s)", color=INK)
    figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, fontsize=9)
    return figure


def _ahead(every: Sequence[np.ndarray], leader: np.ndarray) -> bool:
    """Whether a flight was ahead of the leader somewhere."""
    return any(np.any(times < leader[: len(times)]) for times in every)


def trajectory_figure(groups: Groups, gates: Sequence[GateSection]) -> Figure:
    """Each group's fastest flights from above and its altitude, one color scale and equal axes.

    A column for each group, at most ``ACROSS`` in a row; the title has the total of the fastest
    flight, which alone is drawn where there are more than five.
    """
    shown = {
        group: list(flights) if len(flights) <= 5 else [fastest(flights)]
        for group, flights in groups.items()
    }
    every = [flight for flights in shown.values() for flight in flights]
    lowest, highest = extent(every, gates)
    size, speeds = highest - lowest, range_of(every)
    columns = min(len(groups), ACROSS)
    blocks = -(-len(groups) // columns)
    wide = 9.0 / columns if columns > 1 else 5.0
    tall = wide / size[0] * (size[1] + size[2]) + 0.75
    figure = new_figure(wide * columns + 1.2, tall * blocks)
    heights = [size[1], size[2]] * blocks
    grid = figure.subplots(
        2 * blocks, columns, sharex=True, sharey="row", height_ratios=heights, squeeze=False
    )
    for index, (group, flights) in enumerate(shown.items()):
        above, side = grid[2 * (index // columns) : 2 * (index // columns) + 2, index % columns]
        for flight in flights:
            points = flight["position"] * np.array([1.0, 1.0, -1.0])
            width = 1.6 if len(flights) == 1 else 0.9
            lines = speed_line(above, points[:, :2], flight.speed, speeds, width)
            speed_line(side, points[:, [0, 2]], flight.speed, speeds, width)
        for gate in gates:
            draw_gate(above, gate, 0.07 * float(size.max()), scale=0.5)
            draw_gate_from_side(side, gate)
        side.axhline(0.0, color=MUTED, lw=1.5)
        above.set(xlim=(lowest[0], highest[0]), ylim=(highest[1], lowest[1]), aspect="equal")
        side.set(ylim=(lowest[2], highest[2]), aspect="equal")
        above.set_title(_title(group, flights), color=INK, fontsize=10, loc="left")
        for axes in (above, side):
            tidy(axes)
        side.set_xlabel("x, north (m)", color=INK)
    for axes in grid.flat:
        axes.set_visible(axes.has_data())
    for block in range(blocks):
        grid[2 * block, 0].set_ylabel("y, east (m)", color=INK)
        grid[2 * block + 1, 0].set_ylabel("altitude (m)", color=INK)
    bar = figure.colorbar(lines, ax=grid, pad=0.01, aspect=30, shrink=0.9, extend="min")
    bar.set_label("speed (m/s)", color=INK)
    bar.outline.set_visible(False)
    return figure


def _title(group: str, flights: Sequence[Flight]) -> str:
    best = fastest(flights)
    laps = len(best.lap_times)
    if not np.isfinite(best.total):
        return f"{group}\n{best.crash} in lap {laps + 1}"
    note = f"{best.total:.2f} s, {counted(laps, 'lap')}"
    return f"{group}\n{note}" + (f", fastest of {len(flights)}" if len(flights) > 1 else "")
