"""Matplotlib figures of flights in space, and of height and attitude over time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from quadjax.core.errors import InputError
from quadjax.core.plotting import INK, MUTED, SERIES, SPEED_COLORS, head, new_figure, tidy
from quadjax.evaluation.figures import speed_range
from quadjax.evaluation.scene import gate_outline
from quadjax.flights.flight import Flight
from quadjax.race.track import GateSection

UP = np.array([1.0, 1.0, -1.0])  # NED to north, east, height
ELEVATION, AZIMUTH = 28.0, -62.0  # deg, of the view


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
    low, high = speed_range(flights)
    for flight in flights:
        points = flight["position"] * UP
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        lines = Line3DCollection(list(pieces), cmap=SPEED_COLORS, linewidths=1.8)
        lines.set_array(0.5 * (flight.speed[:-1] + flight.speed[1:]))
        lines.set_clim(low, high)
        axes.add_collection3d(lines)
        axes.plot(*points[:, :2].T, 0.0, color=MUTED, lw=0.8, alpha=0.5)
    for index, gate in enumerate(gates):
        outline = gate_outline(gate) * UP
        axes.plot(*outline.T, color=INK, lw=2.2)
        top = outline[outline[:, 2].argmax()]
        axes.text(*top, f" {index + 1}", color=INK, fontsize=9)
    every = np.concatenate(
        [flight["position"] * UP for flight in flights]
        + [gate_outline(gate) * UP for gate in gates]
    )
    lowest, highest = every.min(axis=0) - 0.3, every.max(axis=0) + 0.3
    lowest[2] = 0.0
    axes.set(xlim=(lowest[0], highest[0]), ylim=(highest[1], lowest[1]), zlim=(0.0, highest[2]))
    axes.set_box_aspect(highest - lowest, zoom=1.1)
    axes.zaxis.set_major_locator(MaxNLocator(4))
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set_xlabel("x, north (m)", color=INK)
    axes.set_ylabel("y, east (m)", color=INK)
    axes.set_zlabel("height (m)", color=INK)
    axes.set_title(title, color=INK, fontsize=13, loc="left")
    bar = figure.colorbar(lines, ax=axes, shrink=0.7, pad=0.1, extend="min")
    bar.set_label("speed (m/s)", color=INK)
    bar.outline.set_visible(False)
    return figure


def attitude_figure(flights: dict[str, Flight], title: str = "") -> Figure:
    """Height, speed, roll, pitch and yaw of flights over time.

    Args:
        flights: by their names, at most as many as there are colors.
        title: of the figure.

    Raises:
        InputError: no flight, or more than colors.
    """
    if not 0 < len(flights) <= len(SERIES):
        raise InputError(f"{len(flights)} flights to draw, allowed: 1 to {len(SERIES)}")
    figure = new_figure(9.0, 8.0)
    several = len(flights) > 1
    panels = figure.subplots(5, 1, sharex=True)
    for (name, flight), color in zip(flights.items(), SERIES, strict=False):
        angles = np.degrees(np.unwrap(flight["attitude"], axis=0)).T
        rows = (-flight["position"][:, 2], flight.speed, *angles)
        for axes, values in zip(panels, rows, strict=True):
            axes.plot(flight.time, values, color=color, lw=1.3, label=name if several else None)
            for end in () if several else flight.lap_ends:
                axes.axvline(end, color=MUTED, lw=0.9, ls="--", zorder=0)
    labels = ("height (m)", "speed (m/s)", "roll (deg)", "pitch (deg)", "yaw (deg)")
    for axes, label in zip(panels, labels, strict=True):
        tidy(axes)
        axes.margins(x=0.01)
        axes.set_ylabel(label, color=INK)
    panels[-1].set_xlabel("time (s)", color=INK)
    head(panels[0], title)
    return figure
