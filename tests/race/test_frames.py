"""Solid frames: the line of a step against the material, in float64."""

import numpy as np
import pytest

from quadjax.race.rules import HIT_A_GATE
from tests import reference as ref
from tests.race.support import level, ruled, step, track_of

DT, WIDTH, DEPTH = 0.01, 0.4, 0.1  # s, m: an opening of 1 m, outer edges at 0.9 m, faces at 0.05 m
FAST = 0.28  # m, a step of 28 m/s
EDGE = 2e-3  # m, from the surface of the material, where float32 may decide either way

STEPS = [  # from, to (through, right, down of a gate's center, m), whether the frame is hit
    *(  # 28 m/s straight through the plane, forwards and backwards, at 0 to 1.1 m from the center
        ([-sign * (FAST - past), right, down], [sign * past, right, down], hit)
        for sign in (1, -1)
        for past in (0.06, 0.14, 0.22)
        for right, down, hit in (
            (0.0, 0.0, False),
            (0.45, 0.45, False),
            (0.6, 0.0, True),
            (0.0, -0.8, True),
            (0.85, 0.85, True),
            (0.95, 0.0, False),
            (0.0, 1.1, False),
        )
    ),
    ([-0.06, 0.0, 0.7], [-0.05 - 0.28, 0.0, 0.7], False),  # away from the front face
    ([-0.34, 0.7, 0.0], [-0.06, 0.7, 0.0], False),  # up to it
    ([-0.34, 0.7, 0.0], [-0.04, 0.7, 0.0], True),  # into it, a sample within the material
    ([0.03, 0.7, 0.1], [0.03, 0.7, 0.1], True),  # at rest within it
    ([0.04, 0.7, 0.1], [0.32, 0.7, 0.1], True),  # out of it
    # Oblique: in the opening at the plane, in its side before or behind it.
    ([-0.20, 0.36, 0.0], [0.08, 0.54, 0.0], True),  # at 0.489 m in the plane, 0.521 m at the face
    ([-0.20, 0.30, 0.0], [0.08, 0.46, 0.0], False),
    ([-0.08, 0.54, 0.0], [0.20, 0.36, 0.0], True),
    ([-0.14, 0.85, 0.0], [0.14, 1.00, 0.0], True),  # 0.925 m at the plane, 0.898 m at the face
    ([-0.14, 0.89, 0.0], [0.14, 1.03, 0.0], False),  # 0.935 m at the face
    # Along the plane: within the depth of the frame, and in front of it.
    ([0.0, 0.40, 0.0], [0.0, 0.68, 0.0], True),
    ([0.02, -0.78, -0.8], [0.02, -1.0, -0.55], True),  # across a corner, both ends outside
    ([0.02, -0.82, -1.01], [0.02, -1.01, -0.82], False),  # past the corner
    ([0.02, 1.2, 0.3], [0.02, 0.92, 0.3], False),
    ([-0.07, 0.40, 0.0], [-0.07, 0.68, 0.0], False),
    ([0.04, -0.14, 0.3], [0.04, 0.14, 0.3], False),
]


def frames(track, rows, **changed):
    """Whether steps between rows of world positions (n, 2, 3), m, hit; the target is gate 0."""
    environment, params = ruled(rules__gate_frame=WIDTH, rules__gate_depth=DEPTH, **changed)
    moved = level(rows[:, 0], (rows[:, 1] - rows[:, 0]) / DT)
    _, _, outcome = step((environment, params.replace(track=track)), moved, target=0)
    return outcome.crashes[HIT_A_GATE]


def gates(tilt=(0.0, 0.0), size=(1.0, 1.0), shape="rectangle"):
    """A target far above, facing away, and two gates with their axes, centers and half sizes."""
    centers, yaw = np.array([[0, 0, -8.0], [-4, 2, -3], [4, -2, -3]]), np.array([0, 0.3, -2.0])
    angles = np.array([[0.0, 0.0], tilt, tilt])
    track = track_of(centers, yaw, size, tilt=angles, shape=shape)
    axes = ref.rotation(np.column_stack([angles, yaw]))
    return track, [(axes[i], centers[i]) for i in (1, 2)]


def away_from_the_target(rows):
    """Steps (n, 2, 3) that do not cross the plane x = 0 of the target forwards."""
    return (rows[:, 0, 0] >= 0) | (rows[:, 1, 0] < 0)


def test_frames_of_other_gates_by_hand():
    track, others = gates()
    for axes, center in others:
        rows = np.array([[before, after] for before, after, _ in STEPS]) @ axes.T + center
        assert away_from_the_target(rows).all()
        np.testing.assert_array_equal(frames(track, rows), [hit for *_, hit in STEPS])


def material(place, half, circle, grown):
    """Whether points (..., 3) in a gate's frame are in the frame, grown by a distance, m."""
    inner, outer = half - grown, half + WIDTH + grown
    aside = np.hypot(*np.moveaxis(place[..., 1:], -1, 0))
    if circle:
        ring = (aside > inner[0]) & (aside <= outer[0])
    else:
        within = [np.all(np.abs(place[..., 1:]) <= edge, axis=-1) for edge in (inner, outer)]
        ring = ~within[0] & within[1]
    return ring & (np.abs(place[..., 0]) <= 0.5 * DEPTH + grown)


@pytest.mark.parametrize("radius", [1e-4, 0.15])
@pytest.mark.parametrize("circle", [False, True])
def test_frames_against_points_of_the_line(circle, radius):
    """Random steps of up to 35 m/s around tilted gates, against 2,000 points of each."""
    size, draw = (1.4, 1.4 if circle else 0.8), np.random.default_rng(0)
    shape = "circle" if circle else "rectangle"
    track, others = gates(np.radians([25.0, -40.0]), size, shape)
    for axes, center in others:
        middle = draw.uniform(-1, 1, (600, 3)) * [0.3, 1.5, 1.5]
        way = draw.uniform(-0.175, 0.175, (600, 3))
        local = np.stack([middle - way, middle + way], axis=1)
        rows = local @ axes.T + center
        local, rows = (x[away_from_the_target(rows)] for x in (local, rows))
        fraction = np.linspace(0.0, 1.0, 2000)[:, None, None]
        points = local[:, 0] + fraction * (local[:, 1] - local[:, 0])
        surely, perhaps = (
            material(points, np.array(size) / 2, circle, radius + grown).any(axis=0)
            for grown in (-EDGE, EDGE)
        )
        known = surely == perhaps
        assert known.mean() > 0.9 and surely.sum() > 50 and (~perhaps).sum() > 50
        found = frames(track, rows, rules__body_radius=radius)
        np.testing.assert_array_equal(found[known], surely[known])
