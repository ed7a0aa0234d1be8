"""Flights as an animated GIF: from above and in perspective, with a lap clock.

Needs only Pillow. Frames are drawn at twice their size and halved, which smooths lines.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.core.plotting import SPEED_COLORS
from quadjax.evaluation import scene
from quadjax.evaluation.figures import gate_labels, label_places, same_place, speed_range
from quadjax.evaluation.scene import View
from quadjax.flights.flight import Flight
from quadjax.race.track import GateSection

FRAMES_PER_SECOND = 20  # a GIF counts in hundredths of a second
HOLD_SECONDS = 1.5  # the last frame
TRAIL_SECONDS = 0.8
WIDTH, HEIGHT = 960, 440  # px
SMOOTH = 2
COLORS = 96
SHADES = 24  # of the trail
CLOCK_ROW = 0.07  # of the height: where the clock, the lap times and the speeds stand
LEGEND = (0.66, 0.78)  # of the width: the bar of the speeds' colors
NAME_OFFSET = 30  # px, before halving, of a drone's name from its middle


def frame_count(flights: Sequence[Flight]) -> int:
    """Number of frames of the flights."""
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
        names: shown next to the drones, one for each flight, or none.

    Raises:
        InputError: another suffix, no flight, or a path that cannot be written.
    """
    if Path(path).suffix.lower() != ".gif":
        raise InputError(f"{path}: suffix is {Path(path).suffix!r}, allowed: .gif")
    if not flights:
        raise InputError(f"{path}: no flight to animate")
    with whole_file(path) as temporary:
        _save(temporary, _frames(flights, gates, names, advance), frame_count(flights))


def _frames(
    flights: Sequence[Flight],
    gates: Sequence[GateSection],
    names: Sequence[str],
    advance: Callable[[], object],
) -> Iterator[Image.Image]:
    """The frames, in one palette."""
    film, count = Film(flights, gates, names), frame_count(flights)
    palette = film.palette(count)
    for index in range(count):
        yield film.frame(index).quantize(palette=palette, dither=Image.Dither.NONE)
        advance()


def _save(path: Path, frames: Iterator[Image.Image], count: int) -> None:
    next(frames).save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=[1000 // FRAMES_PER_SECOND] * (count - 1) + [int(1000 * HOLD_SECONDS)],
        loop=0,
        disposal=1,
        optimize=True,  # only changed pixels are written
    )


class Film:
    """The frames of flights; the background is drawn once."""

    def __init__(
        self,
        flights: Sequence[Flight],
        gates: Sequence[GateSection],
        names: Sequence[str] = (),
    ) -> None:
        """Choose the views and draw the background."""
        self._flights = flights
        self._names = names or [""] * len(flights)
        self._laps = max(len(flight.lap_ends) for flight in flights)
        self._shown = speed_range(flights)
        shades = SPEED_COLORS(np.linspace(0.0, 1.0, SHADES))[:, :3]
        self._shades = [tuple(int(255 * x) for x in color) for color in shades]
        every = np.concatenate([flight["position"] for flight in flights])
        every = np.concatenate([every, *(scene.gate_corners(gate) for gate in gates)])
        self._lowest = np.floor(every.min(axis=0) - 0.7)
        self._highest = np.ceil(every.max(axis=0) + 0.7)
        self._top = float(every[:, 2].min())
        self._views = self._choose_views()
        self._fonts = {size: _font(size * SMOOTH) for size in (13, 24)}
        self._still = self._draw_still(gates)

    def _choose_views(self) -> tuple[View, View]:
        low, high = self._lowest, self._highest
        ends = ((low[0], high[0]), (low[1], high[1]), (self._top, 0.0))
        corners = np.array(list(itertools.product(*ends)))
        middle = 0.5 * (low + high) * np.array([1.0, 1.0, 0.5])
        spread = float(np.linalg.norm((high - low)[:2]))
        above, side = scene.from_above(), scene.from_the_side(middle, 1.3 * spread)
        w, h = WIDTH * SMOOTH, HEIGHT * SMOOTH
        return (
            scene.fit_view(above, corners, (0.02 * w, 0.14 * h, 0.47 * w, 0.94 * h)),
            scene.fit_view(side, corners, (0.50 * w, 0.16 * h, 0.985 * w, 0.97 * h)),
        )

    def _draw_still(self, gates: Sequence[GateSection]) -> Image.Image:
        image = Image.new("RGB", (WIDTH * SMOOTH, HEIGHT * SMOOTH), scene.BACKGROUND)
        draw = ImageDraw.Draw(image)
        for view in self._views:
            scene.draw_floor(draw, view, self._lowest[:2], self._highest[:2])
        for view in self._views:
            scene.draw_gates(draw, view, gates)
        places = label_places(gates, 30 * SMOOTH / self._views[0].scale)
        for group in same_place(places):
            x, y = self._views[0].project(np.append(places[group[0]], 0.0))
            text = ": ".join(filter(None, gate_labels(gates, group)))
            draw.text((x, y), text, font=self._fonts[13], fill=scene.FAINT, anchor="mm")
        x, y = 0.02 * WIDTH * SMOOTH, 0.955 * HEIGHT * SMOOTH
        note = "from above: north to the right, east down; grid 1 m"
        draw.text((x, y), note, font=self._fonts[13], fill=scene.FAINT, anchor="lm")
        self._draw_legend(draw)
        return image

    def _draw_legend(self, draw: ImageDraw.ImageDraw) -> None:
        """Draw the color scale of the speed; lower speeds have the lowest color."""
        left, right = (x * WIDTH * SMOOTH for x in LEGEND)
        edges = np.linspace(left, right, SHADES + 1)
        y, half = CLOCK_ROW * HEIGHT * SMOOTH, 5 * SMOOTH
        for start, end, shade in zip(edges[:-1], edges[1:], self._shades, strict=True):
            draw.rectangle([start, y - half, end, y + half], fill=shade)
        gap, (low, high) = 6 * SMOOTH, self._shown
        for x, text, anchor in (
            (left - gap, f"\u2264 {low:.1f}", "rm"),
            (right + gap, f"{high:.1f} m/s", "lm"),
        ):
            draw.text((x, y), text, font=self._fonts[13], fill=scene.FAINT, anchor=anchor)

    def palette(self, count: int) -> Image.Image:
        """The color palette of all frames."""
        last = self.frame(count - 1)
        sample = Image.new("RGB", (WIDTH, HEIGHT + SHADES), scene.BACKGROUND)
        sample.paste(last, (0, 0))
        draw = ImageDraw.Draw(sample)
        for index, shade in enumerate(self._shades):
            draw.line([(0, HEIGHT + index), (WIDTH, HEIGHT + index)], fill=shade)
        return sample.quantize(COLORS, method=Image.Quantize.MEDIANCUT)

    def frame(self, index: int) -> Image.Image:
        """The frame at ``index``, (HEIGHT, WIDTH) RGB."""
        now = index / FRAMES_PER_SECOND
        image = self._still.copy()
        draw = ImageDraw.Draw(image)
        for flight, name in zip(self._flights, self._names, strict=True):
            last = min(int(np.searchsorted(flight.time, now + 1e-9)), len(flight.time) - 1)
            ended = now >= flight.time[-1]
            for view in self._views:
                self._draw_flight(draw, view, flight, last, ended)
                x, y = view.project(flight["position"][last])
                place = (x + NAME_OFFSET, y - NAME_OFFSET)
                draw.text(place, name, font=self._fonts[13], fill=scene.TEXT, anchor="ls")
        self._draw_clock(draw, now)
        return image.reduce(SMOOTH)

    def _draw_flight(
        self, draw: ImageDraw.ImageDraw, view: View, flight: Flight, last: int, ended: bool
    ) -> None:
        dt = float(flight.time[1] - flight.time[0])
        first = max(0, last - round(TRAIL_SECONDS / dt))
        trail = view.project(flight["position"][first : last + 1])
        low, high = self._shown
        level = (flight.speed[first : last + 1] - low) / (high - low)
        shade = np.clip(level * SHADES, 0, SHADES - 1).astype(int)
        for start in range(0, len(trail) - 1, 2):
            piece, age = trail[start : start + 3], start / max(len(trail) - 1, 1)
            scene.polyline(draw, piece, self._shades[shade[start]], round(2 + 7 * age))
        position = flight["position"][last]
        ground = position * np.array([1.0, 1.0, 0.0])
        if np.isfinite(view.distance):
            scene.dot(draw, view.project(ground), 6.0, scene.SHADOW)
        scene.draw_drone(draw, view, position, flight["attitude"][last])
        if ended and flight.crash:
            scene.draw_cross(draw, view.project(position))

    def _draw_clock(self, draw: ImageDraw.ImageDraw, now: float) -> None:
        """Draw time, lap, lap times and speed of the leading drone."""
        lead = max(self._flights, key=lambda f: (np.sum(f.lap_ends <= now), -f.time[-1]))
        now = min(now, float(lead.time[-1]))
        done = int(np.sum(lead.lap_ends <= now + 1e-6))
        note = f"lap {min(done + 1, max(self._laps, 1))} of {max(self._laps, 1)}"
        times = np.diff(lead.lap_ends[:done], prepend=0.0)
        note += "".join(f"   {time:.2f}" for time in times[-6:])
        step = min(int(np.searchsorted(lead.time, now)), len(lead.time) - 1)
        for x, text, size, anchor in (
            (0.02, f"{now:5.2f} s", 24, "lm"),
            (0.15, note, 13, "lm"),
            (0.98, f"{lead.speed[step]:.1f} m/s", 24, "rm"),
        ):
            place = (x * WIDTH * SMOOTH, CLOCK_ROW * HEIGHT * SMOOTH)
            draw.text(place, text, font=self._fonts[size], fill=scene.TEXT, anchor=anchor)


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)
