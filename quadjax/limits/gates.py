"""The gates of a flight in float64: centers, axes, openings. World NED, m."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.race.track import Track

OCTAGON = np.pi / 4.0 * np.arange(8)  # angles of the corners of a round opening's octagon


@dataclasses.dataclass(frozen=True, eq=False)
class Gates:
    """Gates in the order of passage."""

    position: np.ndarray  # (gates, 3) centers, m
    axes: np.ndarray  # (gates, 3, 3) unit vectors: through the opening, along its width, its height
    half_size: np.ndarray  # (gates, 2) half width, half height, m; the radius of a round opening
    circle: np.ndarray  # (gates,) bool, round openings

    def corners(self, index: int, clearance: float | None) -> np.ndarray:
        """Corners (n, 3) of a convex set that contains what a clearance, m, leaves of an opening.

        Without a clearance (None): the center.
        """
        if clearance is None:
            return self.position[index][None]
        width, height = self.half_size[index] - clearance
        if self.circle[index]:
            size = width / np.cos(np.pi / 8.0)  # of the octagon around the circle
            sides = size * np.stack([np.cos(OCTAGON), np.sin(OCTAGON)], axis=1)
        else:
            sides = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [width, height]
        return self.position[index] + sides @ self.axes[index, 1:]

    def clearance(self, index: int, place: np.ndarray) -> float:
        """Distance of a place in the gate's plane from the nearest edge, m; negative outside."""
        width, height = self.half_size[index]
        _, right, down = self.axes[index] @ (place - self.position[index])
        if self.circle[index]:
            return float(width - np.hypot(right, down))
        return float(min(width - abs(right), height - abs(down)))


def gates_of(track: Track, radius: float = 0.0) -> Gates:
    """The gates of a track, with openings that are smaller by a drone's radius, m, on each side.

    Raises:
        InputError: an opening is not wider than the drone.
    """
    position = np.stack([np.asarray(x, np.float64) for x in track.position.components()], 1)
    sizes = [np.asarray(x, np.float64) for x in (track.half_width, track.half_height)]
    half = np.stack(sizes, 1) - radius
    if np.any(half <= 0.0):
        gate = int(np.argmin(half.min(axis=1))) + 1
        raise InputError(f"gate {gate}: no wider than the drone, rules.body_radius {radius:g} m")
    yaw = np.asarray(track.yaw, np.float64)
    angles = np.stack([yaw, np.zeros_like(yaw), np.zeros_like(yaw)], axis=1)
    if track.attitude is not None:
        opening = {name: np.asarray(x, np.float64) for name, x in vars(track.attitude).items()}
        for column, name in ((1, "pitch"), (2, "roll")):
            angles[:, column] = np.arctan2(opening[f"sin_{name}"], opening[f"cos_{name}"])
    axes = Rotation.from_euler("ZYX", angles).as_matrix().transpose(0, 2, 1)
    circle = np.zeros(len(yaw), bool) if track.circle is None else np.asarray(track.circle)
    return Gates(position, axes, half, circle)
