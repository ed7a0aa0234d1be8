"""Drawing for animations: views of the world, gates, drones."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from PIL import ImageDraw

from quadjax.race.track import GateSection

BACKGROUND = (15, 22, 33)
FLOOR = (38, 50, 67)
GATE = (225, 231, 240)
TEXT = (225, 231, 240)
FAINT = (122, 136, 156)
FRONT = (255, 255, 255)
REAR = (255, 138, 76)
CRASH = (255, 82, 104)
SHADOW = (84, 98, 120)
ARM = 0.24  # m from the drone's center to a rotor: twice the Bebop's, for visibility
ROTOR = 0.11  # m, radius drawn


@dataclasses.dataclass(frozen=True)
class View:
    """A camera, which maps points of the world to the canvas."""

    axes: np.ndarray  # (3, 3): rows right, down and away from the viewer, world NED
    origin: np.ndarray  # (3,) m, the point looked at
    center: np.ndarray  # (2,) px, where it appears
    scale: float  # px/m there
    distance: float  # m from the viewer to the origin; infinite: parallel

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (.., 2) of points (.., 3), m, world."""
        local = (points - self.origin) @ self.axes.T
        nearness = 1.0 / (1.0 + local[..., 2:] / self.distance)
        return self.center + self.scale * nearness * local[..., :2]


def fit_view(view: View, points: np.ndarray, box: tuple[float, float, float, float]) -> View:
    """The same view, moved and scaled to fit points (n, 3) in (left, top, right, bottom)."""
    plain = dataclasses.replace(view, center=np.zeros(2), scale=1.0).project(points)
    lowest, highest = plain.min(axis=0), plain.max(axis=0)
    corner, size = np.array(box[:2]), np.array(box[2:]) - np.array(box[:2])
    scale = float((size / (highest - lowest)).min())
    center = corner + 0.5 * size - 0.5 * scale * (lowest + highest)
    return dataclasses.replace(view, center=center, scale=scale)


def from_above() -> View:
    """Parallel, from above: north to the right, east down."""
    return View(
        np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), np.zeros(3), np.zeros(2), 1.0, np.inf
    )


def from_the_side(
    origin: np.ndarray, distance: float, heading_deg: float = -72.0, down_deg: float = 26.0
) -> View:
    """In perspective, looking along a heading and down by an angle."""
    heading, down = np.radians([heading_deg, down_deg])
    ahead = np.array([np.cos(down) * np.cos(heading), np.cos(down) * np.sin(heading), np.sin(down)])
    right = np.array([-np.sin(heading), np.cos(heading), 0.0])
    axes = np.stack([right, np.cross(ahead, right), ahead])
    return View(axes, origin, np.zeros(2), 1.0, distance)


def body_axes(euler: np.ndarray) -> np.ndarray:
    """Body-to-world rotation (3, 3) of Euler angles (3,), rad."""
    (s1, s2, s3), (c1, c2, c3) = np.sin(euler), np.cos(euler)
    roll = np.array([[1.0, 0, 0], [0, c1, -s1], [0, s1, c1]])
    pitch = np.array([[c2, 0, s2], [0, 1.0, 0], [-s2, 0, c2]])
    yaw = np.array([[c3, -s3, 0], [s3, c3, 0], [0, 0, 1.0]])
    return yaw @ pitch @ roll


def gate_corners(gate: GateSection) -> np.ndarray:
    """Corners (4, 3) of a gate's opening in order, m, world."""
    _, right, down = np.array(gate.axes).T
    right, down = 0.5 * gate.size[0] * right, 0.5 * gate.size[1] * down
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.array([np.array(gate.position) + a * right + b * down for a, b in signs])


def gate_outline(gate: GateSection) -> np.ndarray:
    """The closed outline (n, 3) of a gate's opening, m, world: four corners, or a circle."""
    if gate.shape == "rectangle":
        corners = gate_corners(gate)
        return np.concatenate([corners, corners[:1]])
    _, right, down = 0.5 * gate.size[0] * np.array(gate.axes).T
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:, None]
    return np.array(gate.position) + np.cos(turn) * right + np.sin(turn) * down


def polyline(
    draw: ImageDraw.ImageDraw, points: np.ndarray, color: tuple[int, int, int], width: int
) -> None:
    """Draw a line through pixels (n, 2)."""
    draw.line([tuple(p) for p in points], fill=color, width=width, joint="curve")


def dot(
    draw: ImageDraw.ImageDraw, point: np.ndarray, radius: float, color: tuple[int, int, int]
) -> None:
    """A disc at a pixel (2,)."""
    x, y = point
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=color)


def draw_gates(draw: ImageDraw.ImageDraw, view: View, gates: Sequence[GateSection]) -> None:
    """Draw gates as frames with an arrow in the direction of passage; in perspective on posts."""
    for gate in gates:
        outline = view.project(gate_outline(gate))
        if np.isfinite(view.distance):
            rim = gate_outline(gate)
            lowest = (
                gate_corners(gate)[2:] if gate.shape == "rectangle" else rim[[rim[:, 2].argmax()]]
            )
            for lower in lowest:
                foot = lower * np.array([1.0, 1.0, 0.0])
                polyline(draw, view.project(np.array([lower, foot])), SHADOW, 3)
        polyline(draw, np.concatenate([outline, outline[1:2]]), GATE, 8)
        for corner in outline:
            dot(draw, corner, 4.0, GATE)
        ahead, right, _ = np.array(gate.axes).T
        center = np.array(gate.position)
        tip = center + 0.3 * ahead
        barbs = [tip - 0.12 * ahead + side * 0.07 * right for side in (-1, 1)]
        polyline(draw, view.project(np.array([center, tip])), FAINT, 4)
        draw.polygon([tuple(p) for p in view.project(np.array([tip, *barbs]))], fill=FAINT)


def draw_floor(
    draw: ImageDraw.ImageDraw, view: View, lowest: np.ndarray, highest: np.ndarray
) -> None:
    """A grid of 1 m on the ground between two corners (2,), whole meters."""
    low, high = lowest, highest
    for axis in (0, 1):
        for value in np.arange(low[axis], high[axis] + 0.5):
            ends = np.zeros((2, 3))
            ends[:, axis] = value
            ends[:, 1 - axis] = low[1 - axis], high[1 - axis]
            polyline(draw, view.project(ends), FLOOR, 2)


def draw_drone(
    draw: ImageDraw.ImageDraw, view: View, position: np.ndarray, euler: np.ndarray
) -> None:
    """Four arms and rotor discs in the drone's attitude; the front rotors are white."""
    axes = body_axes(euler)
    diagonal = ARM * np.sqrt(0.5)
    hubs = diagonal * np.array([[1.0, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
    turn = np.linspace(0.0, 2.0 * np.pi, 17)
    ring = ROTOR * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    world = position + hubs @ axes.T
    for a, b in ((0, 2), (1, 3)):
        polyline(draw, view.project(world[[a, b]]), FAINT, 6)
    for index, hub in enumerate(hubs):
        disc = view.project(position + (hub + ring) @ axes.T)
        draw.polygon([tuple(p) for p in disc], fill=FRONT if index < 2 else REAR)


def draw_cross(draw: ImageDraw.ImageDraw, point: np.ndarray, size: float = 14.0) -> None:
    """A cross where a drone crashed."""
    for sign in (-1.0, 1.0):
        ends = point + size * np.array([[-1.0, -sign], [1.0, sign]])
        polyline(draw, ends, CRASH, 7)
