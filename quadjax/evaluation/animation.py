"""Flights as an animated GIF: from above and from the side, with a lap clock."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.core.plotting import INK, SERIES, new_figure, tidy
from quadjax.evaluation.figures import UP, draw_gate, draw_gate_from_side, extent, number_gates
from quadjax.evaluation.table import counted
from quadjax.flights.flight import Flight
from quadjax.race.track import GateSection

FRAMES_PER_SECOND = 20
HOLD_FRAMES = 10  # of the end
TRAIL_SECONDS = 0.8
WIDTH, DPI = 8.0, 90  # inches; dots per inch


def frame_count(flights: Sequence[Flight]) -> int:
    """Number of frames of the flights, without those of the end."""
    longest = max(float(flight.time[-1]) for flight in flights)
    return int(np.ceil(longest * FRAMES_PER_SECOND)) + 1


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
    low, high = extent(flights, gates)
    size = high - low
    figure = new_figure(WIDTH, min(9.0, WIDTH / size[0] * (size[1] + size[2]) + 1.2))
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=[size[1], size[2]])
    for gate in gates:
        draw_gate(above, gate, 0.055 * float(size.max()))
        draw_gate_from_side(side, gate)
    number_gates(above, side, gates, 0.055 * float(size.max()))
    above.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    side.set(ylim=(low[2], high[2]), aspect="equal")
    trails = []
    labels = list(names) or [""] * len(flights)
    for index, (_, name) in enumerate(zip(flights, labels, strict=True)):
        color = SERIES[index % len(SERIES)]
        for axes in (above, side):
            label = name if axes is above else ""
            trails.append(axes.plot([], [], color=color, lw=2.0, label=label)[0])
            trails.append(axes.plot([], [], "o", color=color, ms=8, mec=INK)[0])
    if names:
        above.legend(loc="upper right", frameon=False, labelcolor=INK)
    for axes, label in ((above, "y, east (m)"), (side, "height (m)")):
        tidy(axes)
        axes.set_ylabel(label, color=INK)
    clock = above.set_title("0.00 s", loc="left", color=INK, fontsize=12, family="monospace")
    last = frame_count(flights) - 1

    def draw(frame: int) -> list:
        now = min(frame, last) / FRAMES_PER_SECOND
        for index, flight in enumerate(flights):
            rows = flight.time <= now + 1e-9
            points = flight["position"][rows & (flight.time >= now - TRAIL_SECONDS)] * UP
            points = points if len(points) else flight["position"][rows][-1:] * UP
            for view, columns in enumerate(([0, 1], [0, 2])):
                trail, drone = trails[4 * index + 2 * view : 4 * index + 2 * view + 2]
                trail.set_data(*points[:, columns].T)
                drone.set_data(*points[-1:, columns].T)
        laps = int(np.searchsorted(flights[0].lap_ends, now + 1e-9, side="right"))
        times = "  ".join(f"{time:.2f}" for time in flights[0].lap_times[:laps])
        clock.set_text(f"{now:6.2f} s  {times}" if len(flights) == 1 else f"{now:6.2f} s")
        advance()
        return [*trails, clock]

    figure.canvas.draw()
    figure.set_layout_engine("none")  # once is enough
    film = FuncAnimation(figure, draw, frames=last + 1 + HOLD_FRAMES, init_func=list)
    with whole_file(path) as temporary:
        film.save(temporary, writer=PillowWriter(FRAMES_PER_SECOND), dpi=DPI)
