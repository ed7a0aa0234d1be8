"""The gates of a flight as sets, in float64. World NED."""

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
    world_box: bool = False  # the opening is the box |dx|, |dy|, |dz| of the authors' code
    waypoint: float | None = None  # m: instead, any point within this distance of the center

    @property
    def through(self) -> np.ndarray:
        """Unit vectors (gates, 3) of the direction of passage."""
        return self.axes[:, 0]

    def corners(self, index: int) -> np.ndarray:
        """Corners (n, 3) of a convex set that contains the opening, m."""
        width, height = self.half_size[index]
        _, right, down = self.axes[index]
        if self.waypoint is not None:
            signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
            return self.position[index] + self.waypoint * signs
        if self.circle[index] and not self.world_box:
            size = width / np.cos(np.pi / 8.0)  # of the octagon around the circle
            sides = size * np.stack([np.cos(OCTAGON), np.sin(OCTAGON)], axis=1)
        else:
            if self.world_box:  # the largest distances that the box allows
                box = np.array([width, width, height])
                height = np.abs(down) @ box
                upright = abs(down[2]) > 1.0 - 1e-9
                width = width / max(abs(right[:2])) if upright else np.abs(right) @ box
            sides = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [width, height]
        return self.position[index] + sides[:, :1] * right + sides[:, 1:] * down

    def shrunk(self, index: int, clearance: float | None) -> np.ndarray:
        """Corners (n, 3) of a set that contains what a clearance, m, leaves; None: the center."""
        corners, center = self.corners(index), self.position[index]
        if clearance is None:
            return center[None]
        widest = self.half_size[index].max() if self.waypoint is None else self.waypoint
        return center + (corners - center) * (1.0 - clearance / widest)

    def smallest(self, index: int) -> float:
        """Half of the smallest side of an opening, m."""
        if self.waypoint is not None:
            return self.waypoint
        return float(
            self.half_size[index, 0] if self.circle[index] else self.half_size[index].min()
        )

    def clearance(self, index: int, place: np.ndarray) -> float:
        """Distance of a place in the gate's plane from the nearest edge, m; negative outside."""
        offset = place - self.position[index]
        width, height = self.half_size[index]
        if self.waypoint is not None:
            return float(self.waypoint - np.linalg.norm(offset))
        if self.world_box:
            return float(min(width - np.abs(offset[:2]).max(), height - np.abs(offset[2])))
        _, right, down = self.axes[index] @ offset
        if self.circle[index]:
            return float(width - np.hypot(right, down))
        return float(min(width - abs(right), height - abs(down)))


def gates_of(
    track: Track, world_box: bool = False, waypoint: float | None = None, radius: float = 0.0
) -> Gates:
    """The gates of a track, upright or tilted, rectangular or round.

    Args:
        track: the track.
        world_box: the rule ``gate_test: world_box``.
        waypoint: m; gates are passed within this distance of their centers, in any direction.
        radius: of the drone, m: openings are smaller by it on each side.

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
    if track.opening is not None:
        opening = {name: np.asarray(x, np.float64) for name, x in vars(track.opening).items()}
        for column, name in ((1, "pitch"), (2, "roll")):
            angles[:, column] = np.arctan2(opening[f"sin_{name}"], opening[f"cos_{name}"])
    axes = Rotation.from_euler("ZYX", angles).as_matrix().transpose(0, 2, 1)
    circle = np.zeros(len(yaw), bool) if track.circle is None else np.asarray(track.circle)
    return Gates(position, axes, half, circle, world_box, waypoint)
