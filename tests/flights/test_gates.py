"""Passages of gates, computed by hand."""

import numpy as np
import pytest

from quadjax.flights.gates import LAST_GATE_S, clearance, passages
from quadjax.race.track import GateSection

# Two gates that face each other: north at x = 2, then back south at x = -2.
NORTH = GateSection(position=(2.0, 0.0, -1.5), yaw_deg=0.0, size=(1.0, 0.8))
SOUTH = GateSection(position=(-2.0, 0.0, -1.5), yaw_deg=180.0, size=(1.0, 0.8))
GATES = (NORTH, SOUTH)


def path(*points):
    """Positions (n, 3), 1.5 m high, and times (n,), 0.1 s apart."""
    position = np.array([(x, y, -1.5 + down) for x, y, down in points])
    return 0.1 * np.arange(len(points)), position


def test_time_and_clearance_are_where_the_line_crosses_the_plane():
    # From 1 m before the plane to 3 m after it, y from 0 to 0.4: after a quarter, y is 0.1.
    time, position = path((1.0, 0.0, 0.0), (5.0, 0.4, 0.0))
    passed = passages(time, position, GATES)
    np.testing.assert_allclose(passed, [[0.025, 0.0, 0.4]], atol=1e-12)  # 0.5 - 0.1
    position[:, 2] += 0.2
    assert passages(time, position, GATES)[0, 2] == pytest.approx(0.2)  # 0.4 - 0.2


def test_gates_are_passed_in_order_from_behind_and_inside():
    time, position = path((1, 0, 0), (3, 0, 0), (-1, 0, 0), (-3, 0, 0), (1, 0, 0), (3, 0, 0))
    passed = passages(time, position, GATES, cut=False)
    np.testing.assert_array_equal(passed[:, 1], [0, 1, 0])
    np.testing.assert_allclose(passed[:, 0], [0.05, 0.25, 0.45])
    assert not len(passages(time, position[::-1], (NORTH,), cut=False)[1:])
    assert not len(passages(time, position + [0, 0.6, 0], GATES, cut=False))
    assert len(passages(time, position + [0, 0.6, 0], GATES, reach=0.11, cut=False)) == 3
    assert not len(passages(time, position + [0, 0.6, 0], GATES, reach=0.09, cut=False))
    assert len(passages(time, position, GATES, closed=False, cut=False)) == 2
    assert not len(passages(time, position, ()))


@pytest.mark.parametrize("by_target", [False, True])
def test_gates_that_are_passed_between_two_samples_count_in_their_order(by_target):
    """At 20 m/s a log of 20 Hz has a sample each meter; the gates are 0.3 m apart."""
    gates = tuple(NORTH.replace(position=(x, 0.0, -1.5)) for x in (2.2, 2.5, 2.8, 8.5))
    time, x = 0.05 * np.arange(8), np.arange(1.0, 9.0)
    position = np.stack([x, 0 * x, 0 * x - 1.5], axis=1)
    target = np.array([0, 0, 3, 3, 3, 3, 3, 3]) if by_target else None
    passed = passages(time, position, gates, target=target, cut=False)
    np.testing.assert_array_equal(passed[:, 1], [0, 1, 2])
    np.testing.assert_allclose(passed[:, 0], [0.06, 0.075, 0.09], atol=1e-12)
    turned = tuple(gates[i] for i in (1, 0, 2))  # in another order the second is not passed
    if not by_target:
        np.testing.assert_array_equal(passages(time, position, turned, cut=False)[:, 1], [0])


def test_a_round_gate_has_no_corners():
    """0.64 m from the center is inside a square of 1 m and outside a circle of 0.5 m."""
    square = NORTH.replace(size=(1.0, 1.0))
    circle = square.replace(shape="circle")
    time, position = path((1, 0.45, 0.45), (3, 0.45, 0.45))
    assert passages(time, position, (square,))[0, 2] == pytest.approx(0.05)
    assert not len(passages(time, position, (circle,)))
    inside = passages(time, position * [1, 0.5, 1] - [0, 0, 0.225], (circle,))
    assert inside[0, 2] == pytest.approx(0.5 - np.hypot(0.225, 0.225))


def test_a_gate_that_is_rolled_or_pitched_is_measured_along_its_own_axes():
    rolled = NORTH.replace(roll_deg=90.0)  # its width, 1 m, is now vertical
    time, position = path((1, 0.3, 0.0), (3, 0.3, 0.0))
    assert passages(time, position, (rolled,))[0, 2] == pytest.approx(0.1)
    down = NORTH.replace(pitch_deg=-90.0)  # flown straight down
    position = np.array([[2.1, 0.2, -2.0], [2.1, 0.2, -1.0]])
    np.testing.assert_allclose(
        passages(np.array([0.0, 1.0]), position, (down,)), [[0.5, 0.0, 0.3]], atol=1e-9
    )
    assert clearance(rolled, np.array([0.5, 0.0])) == pytest.approx(0.0)


def test_the_targets_of_a_race_decide_what_is_a_passage():
    """As ``gate_test: world_box``, which passes gates beside their openings."""
    time, position = path((1, 0.7, 0), (3, 0.7, 0), (-3, 0.7, 0))
    target = np.array([0, 1, 0])
    passed = passages(time, position, GATES, target=target, cut=False)
    np.testing.assert_array_equal(passed[:, 1], [0, 1])
    np.testing.assert_allclose(passed[:, 2], [-0.2, -0.2])
    np.testing.assert_allclose(passed[:, 0], [0.05, 0.1 + 0.1 * 5 / 6])


def test_a_flight_may_end_just_before_its_last_gate():
    """At 20 m/s the plane is 0.5 m, so 0.025 s, ahead of the last sample."""
    time = 0.01 * np.arange(6)
    position = np.stack([0.5 + 20.0 * time, 0.1 + 0.0 * time, -1.5 + 0.0 * time], axis=1)
    passed = passages(time, position, GATES)
    np.testing.assert_allclose(passed, [[0.075, 0.0, 0.4]], atol=1e-9)
    assert not len(passages(time, position, GATES, cut=False))
    far = position - [20.0 * LAST_GATE_S, 0.0, 0.0]
    assert not len(passages(time, far, GATES))
    assert not len(passages(time, position + [0, 0.5, 0], GATES))
    assert len(passages(time, position + [0, 0.5, 0], GATES, reach=0.11)) == 1
    target = np.zeros(6)
    assert len(passages(time, position, GATES, target=target)) == 1
    course = GATES[:1]
    whole = np.concatenate([position, position + [4.0, 0.0, 0.0]])
    assert len(passages(0.01 * np.arange(12), whole, course, closed=False)) == 1
