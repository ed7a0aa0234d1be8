"""Whether a move passes a gate's opening, hits beside it, or neither."""

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.race import openings, rewards
from quadjax.race.track import gate, make_track, to_opening_frame
from tests import reference as ref
from tests.convert import vec3
from tests.race.support import by_rows, make_config, through, track_of


def _moved(track, target, before, after, inflation, test="square"):
    g = gate(track, target)
    beyond = rewards.clearance_violation(after, g, jnp.float32(0.1))
    return *openings.crossing(before, after, g, inflation, test), beyond


_move = by_rows(_moved, static_argnames="test")


def move(track, target, before, after, inflation=0.0, test="square"):
    """(passed, hit, clearance violation) of moves between rows of positions."""
    ends = [vec3(np.asarray(x, np.float32)) for x in (before, after)]
    target, inflation = (np.broadcast_to(x, len(before)) for x in (target, inflation))
    return _move(track, target.astype(np.int32), *ends, inflation.astype(np.float32), test=test)


P, H, N = (True, False), (False, True), (False, False)  # passed, hit, neither
BOX = "world_box"
OPENINGS = [  # test, target, before, after, inflation, expected
    *(  # the width and height of a gate
        (test, 4, [-0.05, right, -2 + down], [0.05, right, -2 + down], 0.0, expected)
        for test in ("square", BOX)
        for right, down, expected in ((0.9, 0, P), (1.1, 0, H), (0, 0.25, P), (0, -0.35, H))
    ),
    # The plane itself counts as past it.
    ("square", 5, [-0.1, 0, -2], [0.0, 0, -2], 0.0, P),
    ("square", 5, [0.0, 0, -2], [0.1, 0, -2], 0.0, N),
    *(  # at 45 deg the box's corner reaches 0.707 m sideways, where the square ends at 0.5 m
        (test, 0, through(0, -0.05, right), through(0, 0.001, right), 0.0, expected)
        for right, square, box in ((0.4, P, P), (0.6, H, P), (0.75, H, H))
        for test, expected in (("square", square), (BOX, box))
    ),
    (BOX, 0, through(0, -0.05, 0, 0.51), through(0, 0.001, 0, 0.51), 0.0, H),
    (BOX, 5, [-0.2, 0, -2], [0.49, 0, -2], 0.0, P),
    (BOX, 5, [-0.2, 0, -2], [0.51, 0, -2], 0.0, H),
    ("square", 5, [-0.2, 0, -2], [0.51, 0, -2], 0.0, P),
    (BOX, 5, [-0.2, 0, -2], [0.3, 0, -2], -0.3, H),
    *((BOX, 5, [x, 0, -2], [y, 0, -2], 0.0, N) for x, y in ((0.05, -0.05), (0.05, 0.1))),
    *(  # at 45 deg to the plane, 0.1 m a step: the sample past it is up to 7 cm further aside
        (test, 1, through(1, *before), through(1, *after), 0.0, expected)
        for before, after, sampled, crossed in (
            ((-0.01, 0.47), (0.06, 0.54), H, P),
            ((-0.06, 0.53), (0.01, 0.46), P, P),
            ((-0.01, 0.57), (0.06, 0.48), P, H),
            ((-0.035, 0.40), (0.035, 0.47), P, P),
            ((-0.035, 0.55), (0.035, 0.62), H, H),
        )
        for test, expected in (("square", sampled), ("interpolated", crossed))
    ),
]


@pytest.mark.parametrize("test", ["square", BOX, "interpolated"])
def test_openings_by_hand(test):
    """The square; a gate of its own width and height; one that faces north."""
    places = np.concatenate([ref.GATES, [[0, 0, -2.0], [0, 0, -2.0]]])
    sizes = [[1, 1]] * 4 + [[2.0, 0.6], [1, 1]]
    gates = track_of(places, np.append(ref.GATE_YAW, [0, 0]), sizes)
    rows = [row[1:] for row in OPENINGS if row[0] == test]
    target, before, after, inflation, expected = zip(*rows, strict=True)
    passed, hit, _ = move(gates, target, before, after, inflation, test)
    np.testing.assert_array_equal(np.stack([passed, hit], 1), expected)


TILTS = np.radians([[30.0, 0.0], [0.0, -90.0], [-20.0, 70.0]])  # roll, pitch


@pytest.mark.parametrize("test", ["square", "interpolated"])
@pytest.mark.parametrize("circle", [False, True])
def test_tilted_and_round_openings(circle, test):
    """Moves across each opening's plane, against rotation matrices."""
    yaw, size = np.array([0.3, -2.0, 1.0]), (1.4, 1.4 if circle else 0.8)
    centers = np.array([[1.0, 2, -3], [-2, 0, -2], [0, 3, -4]])
    track = track_of(centers, yaw, size, tilt=TILTS, shape="circle" if circle else "rectangle")
    draw = np.random.default_rng(0)
    for index, matrix in enumerate(ref.rotation(np.column_stack([TILTS, yaw]))):
        after = draw.uniform(-1.2, 1.2, (400, 3)) * [0.1, 1, 1]
        before = after - draw.uniform([0.1, -0.3, -0.3], [0.1, 0.3, 0.3], (400, 3))
        world = [local @ matrix.T + centers[index] for local in (before, after)]
        passed, hit, found = move(track, index, *world, inflation=0.05, test=test)
        crossed = (before[:, 0] < 0) & (after[:, 0] >= 0)
        at = after - (after[:, :1] / 0.1 * (after - before) if test == "interpolated" else 0.0)
        inside = np.all(np.abs(at[:, 1:]) <= np.array(size) / 2 + 0.05, axis=1)
        if circle:
            inside = np.hypot(*at[:, 1:].T) <= 0.75
        np.testing.assert_array_equal(passed, crossed & inside)
        np.testing.assert_array_equal(hit, crossed & ~inside)
        assert passed.sum() > 30 and hit.sum() > 30
        beyond = np.clip(np.abs(after[:, 1:]) - np.array(size) / 2 + 0.1, 0, 1).sum(axis=1)
        if circle:
            beyond = np.clip(np.hypot(*after[:, 1:].T) - 0.6, 0, 2)
        np.testing.assert_allclose(found, beyond, atol=1e-5)


ROUND = "{position: [0, 0, -2], pitch_deg: -90, size: [2, 2], shape: circle}"


def test_tilt_and_shape_of_a_config():
    """A gate to dive through: the passage points down, the opening's height to the front."""
    config = make_config(f"track.gates=[{ROUND}, {{position: [1, 0, -1]}}]")
    track = make_track(config.track)
    opened = by_rows(lambda track, index, way: to_opening_frame(gate(track, index), way).array())
    for index, section in enumerate(config.track.gates):
        axes = opened(track, np.full(3, index, np.int32), vec3(np.eye(3, dtype=np.float32)))
        np.testing.assert_allclose(axes, section.axes, atol=1e-6)
        if index == 0:
            np.testing.assert_allclose(axes[2], [1, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(track.circle, [True, False])
    np.testing.assert_allclose([track.half_width, track.half_height], [[1, 0.5]] * 2)
    assert make_track(make_config().track).attitude is None
