"""Checks of the gates' openings and frames against the rules of the race."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from quadjax.config.drone_checks import refuse
from quadjax.config.schema import Config, Gate


def within(config: Config, position: Sequence[float]) -> bool:
    """Whether a position is within the rules' bounds."""
    box = config.rules.bounds
    return box is None or all(low < x < high for x, (low, high) in zip(position, box, strict=True))


def check_bounds(config: Config) -> None:
    """Check the order of the bounds of each axis.

    Raises:
        InputError: a lowest value that is not below the highest.
    """
    for low, high in config.rules.bounds or ():
        if low >= high:
            refuse("rules.bounds", config.rules.bounds, "[lowest, highest] for each of x, y and z")


def check_openings(config: Config) -> None:
    """Check that no bound cuts an opening, and that frames leave room between the gates.

    Raises:
        InputError: bounds or a width of the frames that do.
    """
    rules, gates = config.rules, config.track.gates
    for index, gate in enumerate(gates):
        if not all(within(config, corner) for corner in _corners(gate)):
            allowed = f"a box with the whole opening of track.gates[{index}], which this one cuts"
            refuse("rules.bounds", rules.bounds, allowed)
    if not rules.gate_frame:
        return
    for i, k in itertools.combinations(range(len(gates)), 2):
        most = 0.5 * math.dist(gates[i].position, gates[k].position)
        if rules.gate_frame >= most > 0.0:
            allowed = f"below {most:.3g} m, half the distance of track.gates[{i}] and [{k}]"
            refuse("rules.gate_frame", rules.gate_frame, allowed)
        for here, there in ((i, k), (k, i)):
            if _covers(config, gates[here], gates[there].position):
                allowed = f"less: the frame of track.gates[{here}] covers the center of [{there}]"
                refuse("rules.gate_frame", rules.gate_frame, allowed)


def check_random_tracks(config: Config) -> None:
    """Check that the random tracks of training fit the starts and the rules.

    Raises:
        InputError: a start or a rule that they do not fit.
    """
    tracks, start, rules = config.randomization.tracks, config.start, config.rules
    if tracks is None:
        return
    if start.heading == "inside_turn":
        refuse("start.heading", start.heading, "north with randomization.tracks")
    if start.position >= tracks.height[0]:
        lowest = f"below {tracks.height[0]:g}, the lowest gate of randomization.tracks"
        refuse("start.position", start.position, lowest)
    if rules.bounds is not None:
        refuse("rules.bounds", rules.bounds, "null with randomization.tracks")
    if (rules.gate_frame or 0.0) > tracks.frame:
        allowed = f"at most {tracks.frame:g}, randomization.tracks.frame"
        refuse("rules.gate_frame", rules.gate_frame, allowed)


def _rotation(gate: Gate) -> np.ndarray:
    """The matrix (3, 3) from the opening's frame (x through it, z its height) to the world."""
    roll, pitch, yaw = np.radians([gate.roll_deg, gate.pitch_deg, gate.yaw_deg])
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_z = np.array([[c, -f, 0.0], [f, c, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[b, 0.0, e], [0.0, 1.0, 0.0], [-e, 0.0, b]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, a, -d], [0.0, d, a]])
    return about_z @ about_y @ about_x


def _corners(gate: Gate) -> np.ndarray:
    """The corners (4, 3) of an opening, or the ends of two diameters of a circle; m, world."""
    signs = [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    if gate.shape == "circle":
        signs = [(0, -1), (0, 1), (-1, 0), (1, 0)]
    offsets = [(0.0, 0.5 * y * gate.size[0], 0.5 * z * gate.size[1]) for y, z in signs]
    return np.array(gate.position) + np.array(offsets) @ _rotation(gate).T


def _covers(config: Config, gate: Gate, position: Sequence[float]) -> bool:
    """Whether the solid frame of a gate covers a position; see ``quadjax.race.rules``."""
    x, y, z = (np.array(position) - gate.position) @ _rotation(gate)
    half_width, half_height = 0.5 * np.array(gate.size)
    outer = config.rules.gate_frame

    def inside(more: float) -> bool:
        if gate.shape == "circle":
            return bool(math.hypot(y, z) <= half_width + more)
        return bool(abs(y) <= half_width + more and abs(z) <= half_height + more)

    return abs(x) <= 0.5 * config.rules.gate_depth and inside(outer) and not inside(0.0)
