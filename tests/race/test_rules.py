"""Gates, collisions and ends of an episode, one step at a time."""

import numpy as np
import pytest

from quadjax.race import rules
from quadjax.race.environment import without_training_limits
from quadjax.race.track import unwrapped_turns
from quadjax.vehicle.motor import MODEL
from tests import reference as ref
from tests.convert import rows_of
from tests.race.support import (
    COURSE,
    by_rows,
    compiled_transition,
    first_score,
    level,
    make_race,
    normal,
    race_state,
    ruled,
    step,
    through,
    track_of,
)

GATE, GROUND, BOUNDS, BODY_RATE, YAW_RATE, ATTITUDE, NOT_FINITE, SPEED = rules.TERMINATIONS
REASONS = ("", *rules.TERMINATIONS)
FAR = np.array([0.0, 0.0, -1.5])  # in the middle of the track, away from every plane


@pytest.fixture(scope="module")
def race():
    return make_race()


@pytest.fixture(scope="module")
def course():
    """A course with other tests of its gates and of the ground."""
    landing = ("rules.ground_speed=5", "rules.ground_height=0.4")
    return make_race(*COURSE, *landing, "rules.gate_test=world_box")


def test_a_body_narrows_openings_hall_and_height():
    """A sphere of 0.2 m: every solid thing is closer by its radius."""
    race = ruled(rules__body_radius=0.2, rules__bounds=[[-3, 4], [-2.5, 2], [-5, 0]])
    offsets = [0.29, 0.31, -0.29, -0.31, 0.0, 0.32]
    rows = level([through(0, -0.03, x) for x in offsets], 0.0)
    rows[:, ref.V] = 5.0 * normal(0)
    _, _, outcome = step(race, rows, target=0)
    np.testing.assert_array_equal(outcome.passed, [True, False, True, False, True, False])
    np.testing.assert_array_equal(outcome.crashes[GATE], ~outcome.passed)
    frames = [(0.0, 0.29), (0.0, 0.31), (0.29, 0.6), (0.31, 0.6), (0.0, 1.09), (0.0, 1.11)]
    rows = level([through(2, *offset) for offset in frames], 0.0)  # of a gate not aimed at
    for inflation, solid in ((0.0, [1, 2, 4]), (0.4, [4])):
        wider = ruled(rules__body_radius=0.2, training_limits__gate_inflation=inflation)
        _, _, outcome = step(wider, rows, target=0)
        assert np.flatnonzero(outcome.crashes[GATE]).tolist() == solid
    ends = np.array([[-2.8, 0, -2], [3.8, 0, -2], [0, -2.3, -2], [0, 1.8, -2], [0, 0, -4.8]])
    places = np.concatenate([0.99 * ends, 1.01 * ends])
    places[:, 2] = np.where(places[:, 2] > -4, -2.0, places[:, 2])
    _, _, outcome = step(race, level([*places, [0, 0, -0.21], [0, 0, -0.19]], 0.0), target=0)
    np.testing.assert_array_equal(outcome.crashes[BOUNDS][:10], [False] * 5 + [True] * 5)
    np.testing.assert_array_equal(outcome.crashes[GROUND], [False] * 11 + [True])


def flags(outcome, index):
    return {name for name, flag in outcome.crashes.items() if flag[index]}


def test_passing_advances_the_target_and_wraps_round(race):
    target = np.arange(4)
    places = np.stack([through(g, -0.02, 0.1, -0.2) for g in target])
    rows = level(places, 5 * np.stack([normal(g) for g in target]))
    following, value, outcome = step(race, rows, target, clock=7)
    assert np.all(outcome.passed) and not np.any(outcome.crashed | outcome.truncated)
    np.testing.assert_array_equal(following.target, (target + 1) % 4)
    assert set(following.gates_passed) == {1} and set(following.clock) == {8}
    np.testing.assert_allclose(value, 10 - 10 * np.linalg.norm([0.03, 0.1, 0.2]), atol=1e-4)


def test_only_the_plane_of_the_target_is_hit(race):
    """A crash at the gate is no pass: the last drone is in the opening and below the ground."""
    places = [through(g, -0.02, 0.6) for g in range(4)] + [through(0, -0.02)]
    rows = level(places, np.stack([5 * normal(g) for g in (0, 1, 2, 3, 0)]))
    target = np.array([0, 1, 2, 3, 2])
    following, value, outcome = step(race, rows, target)
    assert [flags(outcome, index) for index in range(5)] == [{GATE}] * 4 + [set()]
    assert not np.any(outcome.passed) and np.all(following.gates_passed == 0)
    np.testing.assert_array_equal(following.target, target)
    np.testing.assert_array_equal(value[:4], -10)
    buried = race[1].replace(track=track_of(np.array([[0, 0, -0.2]]), np.zeros(1)))
    rows = level(np.array([-0.02, 0, 0.1]), np.array([5.0, 0, 0]))
    following, value, outcome = step((race[0], buried), rows)
    assert flags(outcome, 0) == {GROUND} and not outcome.passed[0] and value[0] == -10


def test_the_plane_of_the_target_is_free_from_the_front(race):
    """From 2 cm in front of it to 3 cm behind, in the opening and beside it: only progress."""
    rows = level([through(0, 0.02), through(0, 0.02, 0.6)], -5 * normal(0))
    following, value, outcome = step(race, rows, target=0)
    assert not np.any(outcome.passed | outcome.crashed)
    np.testing.assert_array_equal(following.target, 0)
    off = [np.hypot(forward, [0.0, 0.6]) for forward in (0.02, 0.03)]
    np.testing.assert_allclose(value, off[0] - off[1], atol=1e-5)


LIMITS = [  # columns of a drone in hover in the middle; what ends its flight in training, in a race
    ({}, "", ""),
    *(({"z": z, "w": 5.0}, *what) for z, what in ((-0.02, [GROUND] * 2), (-0.08, ["", ""]))),
    *(({"z": z, "w": -5.0}, *what) for z, what in ((-8.98, [BOUNDS] * 2), (-8.9, ["", ""]))),
    *(
        ({axis: sign * place, speed: sign * 5.0}, what, what)
        for axis, speed in (("x", "u"), ("y", "v"))
        for sign in (1, -1)
        for place, what in ((9.98, BOUNDS), (9.9, ""))
    ),
    *(
        ({rate: sign * (limit + 1.0)}, BODY_RATE, BODY_RATE)
        for rate, limit in (("p", 5), ("q", 7), ("r", 9))
        for sign in (1, -1)
    ),
    *(({rate: sign * 4.0}, "", "") for rate in "pq" for sign in (1, -1)),
    *(({"r": rate}, what, "") for rate, what in ((4, YAW_RATE), (-4, YAW_RATE), (2, ""))),
    *(
        ({angle: sign * (limit + more)}, what, "")
        for angle, limit in (("roll", 1.3), ("pitch", 1.0))
        for sign in (1, -1)
        for more, what in ((0.01, ATTITUDE), (-0.01, ""))
    ),
    ({"v": 6.0, "w": -6.0}, SPEED, SPEED),
    ({"v": 4.5, "w": -4.5}, "", ""),
]
COLUMNS = dict(zip("xyzuvw", range(6), strict=True), roll=6, pitch=7, p=9, q=10, r=11)


def test_every_limit_of_the_motion():
    """Close to each, with its own text; the limits of training do not hold in timed laps."""
    environment, params = ruled(
        rules__bounds=[[-20, 20], [-20, 20], [-9, 5]],
        rules__body_rate_limit=[5, 7, 9],
        rules__speed_limit=8,
        reward__overspeed=0,
        training_limits__yaw_rate=3,
        training_limits__roll_deg=np.degrees(1.3),
        training_limits__pitch_deg=np.degrees(1.0),
    )
    rows = level(np.tile(FAR, (len(LIMITS), 1)), 0.0)
    for row, (columns, *_) in zip(rows, LIMITS, strict=True):
        for name, value in columns.items():
            row[COLUMNS[name]] = value
    for numbers, place in ((params, 1), (without_training_limits(environment.model, params), 2)):
        following, value, outcome = step((environment, numbers), rows, target=1)
        codes = first_score(rows, 1, following, outcome).crash_code
        for index, (case, code) in enumerate(zip(LIMITS, codes, strict=True)):
            assert REASONS[code] == case[place], case
            assert flags(outcome, index) - {YAW_RATE} == {case[place]} - {"", YAW_RATE}, case
            assert (float(value[index]) == -10) == bool(case[place]) == bool(outcome.crashed[index])
    assert SPEED not in step(make_race(), rows)[2].crashes


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_a_state_that_is_not_finite_is_a_crash_and_nothing_more(kind):
    race = make_race(f"vehicle.model={kind}", "reward.body_rates=0.1", "reward.time=0.2")
    rows = ref.random_states(kind, 4)
    rows[:, ref.P], rows[:, ref.RATES] = FAR, 0.5
    velocity = rows.copy()
    velocity[1, 3] = 3e38  # its square is not finite, nor is its drag
    velocity[1, 6:9] = 0.3
    for bad in (np.nan, np.inf, -np.inf):
        action = np.full((4, 4), 0.1, np.float32)
        action[2, 3] = bad
        following, value, outcome = step(race, velocity, action=action, kind=kind)
        state = rows_of(following.drone)
        assert np.all(np.isfinite(state[[0, 2, 3]])) and np.all(np.isfinite(value[[0, 2, 3]]))
        if np.isnan(bad):
            assert flags(outcome, 2) == {NOT_FINITE} and outcome.crashed[2]
            np.testing.assert_array_equal(state[2], velocity[2].astype(np.float32))
            assert value[2] == pytest.approx(-10 - 0.01 * (0.2 + 0.1 * np.sqrt(0.75)), rel=1e-5)
        else:  # an infinite action is a saturated one
            assert not outcome.crashed[2]
        assert not outcome.crashes[NOT_FINITE][0] and not outcome.crashes[NOT_FINITE][3]
        if kind == "motor":
            assert outcome.crashes[NOT_FINITE][1] and outcome.crashed[1]
            np.testing.assert_array_equal(state[1], velocity[1].astype(np.float32))


def test_timed_laps_have_no_training_limits(race):
    narrow = make_race("training_limits.gate_inflation=-0.1", "training_limits.pitch_deg=60")[1]
    exact = without_training_limits(MODEL, narrow).training_limits
    assert exact.gate_inflation == 0 and exact.roll_deg is None and exact.yaw_rate is None
    limits = (race[1].training_limits, narrow.training_limits, exact)
    np.testing.assert_allclose([each.pitch_deg for each in limits], [85, 60, 89])
    assert make_race("vehicle=5inch")[1].training_limits.pitch_deg is None  # any attitude
    assert (
        without_training_limits(MODEL, narrow.replace(observation_scale=1.0)).observation_scale
        is None
    )


def test_a_course_ends_with_its_last_gate(course):
    rows = np.concatenate([level([through(index, -0.01)], 5.0 * normal(index)) for index in (2, 3)])
    following, value, outcome = step(course, rows, target=[2, 3])
    np.testing.assert_array_equal(outcome.passed, [True, True])
    np.testing.assert_array_equal(outcome.finished, [False, True])
    np.testing.assert_array_equal(outcome.crashed, [False, False])
    assert np.all(value > 0)
    track = course[1].track
    np.testing.assert_allclose([x[3] for x in track.next_position], [5, 0, 0], atol=1e-6)
    assert float(track.next_yaw[3]) == float(unwrapped_turns(track)[3]) == 0
    race = first_score(rows, [2, 3], following, outcome)
    np.testing.assert_allclose(race.lap_end, [[0.0, 0.01]])
    np.testing.assert_array_equal(race.over, [False, True])
    beside = level(through(1, -0.02, 0.6), 2.5 * normal(1))  # the square, in the box of its track
    assert step(course, beside, 1)[2].passed[0]


def test_truncation_is_not_termination(course):
    """The last step of an episode, the last gate of a course, both at once, and a crash."""
    rows = level([through(3, x) for x in (-2, -2, -0.01, -0.01, -2)], 5.0 * normal(3))
    rows[4, 2], rows[4, 5] = -0.01, 8.0
    state = race_state("motor", rows, 3, [1198, 1199, 0, 1199, 1199])
    every_step = by_rows(course[0].step)
    _, value, terminated, truncated = every_step(course[1], state, np.zeros((5, 4), np.float32))
    np.testing.assert_array_equal(terminated, [False, False, True, True, True])
    np.testing.assert_array_equal(truncated, [False, True, False, False, False])
    assert float(value[1]) == pytest.approx(float(value[0]), abs=1e-6) and value[4] == -10


def test_slow_flight_near_the_ground_is_allowed_by_rule(course):
    places, speeds = [[0, 0, z] for z in (-0.3, -0.3, -0.5, 0.1, 0.6)], [4, 6, 6, 1, 1]
    _, _, outcome = step(course, level(places, [[v, 0, 0] for v in speeds]))
    np.testing.assert_array_equal(outcome.crashes[GROUND], [False, True, False, False, True])


def test_full_thrust_takes_off_from_the_ground(course):
    state = race_state("motor", level([-3, -1.5, 0], 0.0))
    for _ in range(20):
        state, _, outcome = compiled_transition(course[0])(course[1], state, np.ones((1, 4), "f"))
    assert not outcome.crashed[0] and state.drone.position.z[0] < 0
