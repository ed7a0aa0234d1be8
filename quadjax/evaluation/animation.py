"""Flights as an animated GIF: from above and from the side, with a lap clock."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.core.plotting import INK, SERIES, new_figure, tidy
from quadjax.evaluation.figures import UP, draw_track, extent
from quadjax.evaluation.table import counted
from quadjax.flights.flight import Flight
from quadjax.race.track import GateSection

FRAMES_PER_SECOND = 20
HOLD_FRAMES = 10  # of the end
TRAIL_SECONDS = 0.8
WIDTH, DPI = 8.0, 90  # inches; dots per inch


def write_animation(
    flights: Sequence[Flight],
    gates: Sequence[GateSection],
    path: Path | str,
    advance: Callable[[], object] = lambda: None,
    names: Sequence[str] = (),
) -> None:
    """Write flights as an animated GIF in real time.

    Args:
        flights: one or more, shown together.
        gates: of the track, in order of passage.
        path: ``.gif``.
        advance: called after every frame.
        names: in the legend, one for each flight, or none.

    Raises:
        InputError: another suffix, no flight, or a path that cannot be written.
    """
    if Path(path).suffix.lower() != ".gif":
        raise InputError(f"{path}: suffix is {Path(path).suffix!r}, allowed: .gif")
    if not flights:
        raise InputError("no flight to draw")
    if names and len(names) != len(flights):
        raise InputError(f"{counted(len(names), 'name')} for {counted(len(flights), 'flight')}")
    limits = extent(flights, gates)
    size = limits[1] - limits[0]
    figure = new_figure(WIDTH, min(9.0, WIDTH / size[0] * (size[1] + size[2]) + 1.2))
    views = above, side = figure.subplots(2, 1, sharex=True, height_ratios=[size[1], size[2]])
    draw_track(above, side, gates, limits)
    lines = []  # of each flight and view: columns of the position, trail and drone
    for index, flight in enumerate(flights):
        color, name = SERIES[index % len(SERIES)], names[index] if names else ""
        for axes, columns in zip(views, ([0, 1], [0, 2]), strict=True):
            (trail,) = axes.plot([], [], color=color, lw=2.0, label=name)
            (drone,) = axes.plot([], [], "o", color=color, ms=8, mec=INK)
            lines.append((flight, columns, trail, drone))
    if names:
        above.legend(loc="upper right", frameon=False, labelcolor=INK)
    for axes, label in zip(views, ("y, east (m)", "height (m)"), strict=True):
        tidy(axes)
        axes.set_ylabel(label, color=INK)
    clock = above.set_title("0.00 s", loc="left", color=INK, fontsize=12, family="monospace")
    last = int(np.ceil(max(float(flight.time[-1]) for flight in flights) * FRAMES_PER_SECOND))

    def draw(frame: int) -> list:
        now = min(frame, last) / FRAMES_PER_SECOND
        for flight, columns, trail, drone in lines:
            count = max(1, int(np.searchsorted(flight.time, now + 1e-9, side="right")))
            first = int(np.searchsorted(flight.time, now - TRAIL_SECONDS))
            points = (flight["position"] * UP)[min(first, count - 1) : count, columns]
            trail.set_data(*points.T)
            drone.set_data(*points[-1:].T)
        laps = int(np.searchsorted(flights[0].lap_ends, now + 1e-9, side="right"))
        times = "  ".join(f"{time:.2f}" for time in flights[0].lap_times[:laps])
        clock.set_text(f"{now:6.2f} s  {times}" if len(flights) == 1 else f"{now:6.2f} s")
        advance()
        return [clock]

    figure.canvas.draw()
    figure.set_layout_engine("none")  # once is enough
    film = FuncAnimation(figure, draw, frames=last + 1 + HOLD_FRAMES, init_func=list)
    with whole_file(path) as temporary:
        film.save(temporary, writer=PillowWriter(FRAMES_PER_SECOND), dpi=DPI)
