"""Gates, collisions, ends of an episode and the reward, one step at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.traced import as_leaves, with_leaves
from quadjax.core.vectors import Vec3
from quadjax.race import rewards, rules
from quadjax.race.environment import exact_rules
from quadjax.race.rewards import REWARDS, Reward
from quadjax.race.track import gate, make_track, to_opening_frame, unwrapped_turns
from quadjax.race.types import Step
from quadjax.vehicle.motor import MODEL
from tests import reference as ref
from tests.convert import rows_of, state_of, vec3
from tests.race.support import (
    COURSE,
    by_rows,
    compiled_reset,
    compiled_transition,
    first_score,
    level,
    make_config,
    make_race,
    normal,
    race_state,
    step,
    through,
    track_of,
)

GATE, GROUND, BOUNDS, BODY_RATE, YAW_RATE, ATTITUDE, NOT_FINITE, SPEED = rules.TERMINATIONS
REASONS = ("", *rules.TERMINATIONS)
FAR = np.array([0.0, 0.0, -1.5])  # in the middle of the track, away from every plane
ONE_TO_GO = np.linalg.norm(ref.GATES[1] - through(0, 0.03, 0.2))  # 3 cm beyond the first gate
# A race with every rule that has a number, one program for all: each test names the numbers that
# it is about.
NUMBERS = {
    "rules.gate_frame": 0.4,
    "rules.gate_depth": 0.2,
    "rules.bounds": [[-9, 9], [-9, 9], [-9, 0]],
    "rules.body_radius": 1e-4,
    "rules.body_rate_limit": [1000, 1000, 1000],
    "rules.speed_limit": 500,
    "reward.overspeed": 5,
    "reward.overspeed_margin": 0.25,
    "start.velocity": 0.5,
    "start.body_rates": 0.1,
}


def ruled(**changed):
    """A race with every rule; an override's first dot is ``__``."""
    numbers = NUMBERS | {key.replace("__", "."): value for key, value in changed.items()}
    return make_race(*(f"{key}={value}" for key, value in numbers.items()))


@pytest.fixture(scope="module")
def race():
    return make_race()


@pytest.fixture(scope="module")
def course():
    """A course with other tests of its gates and of the ground."""
    landing = ("rules.ground_speed=5", "rules.ground_height=0.4")
    return make_race(*COURSE, *landing, "rules.gate_test=world_box")


@pytest.fixture(scope="module")
def gates():
    """The square; a gate of its own width and height; one that faces north."""
    places = np.concatenate([ref.GATES, [[0, 0, -2.0], [0, 0, -2.0]]])
    sizes = [[1, 1]] * 4 + [[2.0, 0.6], [1, 1]]
    return track_of(places, np.append(ref.GATE_YAW, [0, 0]), sizes)


def _moved(track, target, before, after, inflation, test="square"):
    g = gate(track, target)
    beyond = rewards.clearance_violation(after, g, jnp.float32(0.1))
    return *rules.crossing(before, after, g, inflation, test), beyond


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
def test_openings_by_hand(gates, test):
    rows = [row[1:] for row in OPENINGS if row[0] == test]
    target, before, after, inflation, expected = zip(*rows, strict=True)
    passed, hit, _ = move(gates, target, before, after, inflation, test)
    np.testing.assert_array_equal(np.stack([passed, hit], 1), expected)


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
    assert set(following.gates_passed) == {1} and set(following.step) == {8}
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
    choices, params = ruled(
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
    for numbers, place in ((params, 1), (exact_rules(choices.model, params), 2)):
        following, value, outcome = step((choices, numbers), rows, target=1)
        codes = first_score(rows, 1, following, outcome).crash_code
        for index, (case, code) in enumerate(zip(LIMITS, codes, strict=True)):
            assert REASONS[code] == case[place], case
            assert flags(outcome, index) - {YAW_RATE} == {case[place]} - {"", YAW_RATE}, case
            assert (float(value[index]) == -10) == bool(case[place]) == bool(outcome.crashed[index])
    assert SPEED not in step(make_race(), rows)[2].crashes


def test_truncation_is_not_termination(race):
    rows = np.repeat(level(FAR, np.zeros(3)), 3, axis=0)
    rows[2, 2], rows[2, 5] = -0.01, 5.0
    _, value, outcome = step(race, rows, clock=np.array([1198, 1199, 1199]))
    np.testing.assert_array_equal(outcome.truncated, [False, True, False])
    np.testing.assert_array_equal(outcome.crashed, [False, False, True])
    assert float(value[1]) == pytest.approx(float(value[0]), abs=1e-6) and value[2] == -10


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


def weights(**kept):
    """Weights of which all others are zero, but computed: one program for all."""
    zeros = dict.fromkeys((name for name in REWARDS if name != "action_change"), 0.0)
    return as_leaves(Reward(**(zeros | {"gate_edge_reach": 1.0} | kept)), ["perception"])


@pytest.mark.parametrize(
    ("kept", "expected"),
    [  # flying on, passing, hitting
        ({"progress": 2.0}, (2 * 0.05, 0.0, 0.0)),
        ({"gate": 3.0}, (0.0, 3.0, 0.0)),
        ({"gate_offset": 4.0}, (0.0, -4 * np.hypot(0.03, 0.2), 0.0)),
        ({"next_gate_progress": 2.0}, (0.0, 2 * (np.hypot(0.02, 0.2) + 3 - ONE_TO_GO), 0.0)),
        ({"collision": 5.0}, (0.0, 0.0, -5.0)),
        ({"gate_edge": 4.0, "gate_edge_margin": 0.4}, (0.0, -4 * 0.1, -4 * 0.5)),
        ({"gate_edge": 4.0, "gate_edge_margin": 0.1}, (0.0, 0.0, -4 * 0.2)),
        (
            {"gate_edge": 4.0, "gate_edge_margin": 0.4, "gate_edge_reach": 0.45},
            (0.0, -4 * 0.1, -4 * 0.45),
        ),
        ({"time": 6.0}, (-0.06, -0.06, -0.06)),
        ({"body_rates": 7.0}, (-0.07 * 1.5, -0.07 * 1.5, -0.07 * 1.5)),
        ({"pitch_up": 8.0}, (0.0, -0.08 * 0.3, 0.08 * 0.3)),
    ],
)
def test_each_term_of_the_reward(race, kept, expected):
    rows = level(np.stack([through(0, -1), through(0, -0.02, 0.2), through(0, -0.02, 0.6)]), 0.0)
    rows[:, ref.V] = 5 * normal(0)
    choices, params = race
    quiet = {name: jnp.float32(0) for name in ("k_pv", "k_qv", "k_rr")}
    still = params.vehicle.constants.replace(
        **quiet, i_xx=jnp.float32(1), i_yy=jnp.float32(1), i_zz=jnp.float32(1)
    )
    params = params.replace(reward=weights(**kept), vehicle=params.vehicle.replace(constants=still))
    rows[:, ref.RATES] = [1.0, 1.0, 0.5]
    pitch = np.array([0.0, 0.3, -0.3])
    rows[:, ref.EULER.start + 1] = pitch - 0.01  # it rises by so much within the step
    _, value, outcome = step((choices, params), rows)
    assert outcome.passed[1] and outcome.crashes[GATE][2]
    np.testing.assert_allclose(value, expected, atol=2e-5)


def test_default_reward_is_the_published_one(race):
    values = {name: getattr(race[1].reward, name) for name in REWARDS}
    assert {name for name, x in values.items() if x is None} == {"action_change", "perception"}
    assert {name: float(x) for name, x in values.items() if x} == {
        "progress": 1.0,
        "gate": 10.0,
        "gate_offset": 10.0,
        "collision": 10.0,
        "overspeed": 20.0,  # of a race with a speed limit
    }


def test_default_limits_are_the_published_ones(race):
    rules, limits = race[1].rules, race[1].training_limits
    absent = ("bounds", "gate_frame", "ground_speed", "body_radius", "speed_limit")
    assert all(getattr(rules, name) is None for name in absent)
    assert float(rules.time_step) == pytest.approx(0.01) and limits.episode_steps == 1200
    assert rules.position_limit == 10 and rules.body_rate_limit == 1000
    assert limits.gate_inflation == 0 and limits.yaw_rate is None
    narrow = make_race("training_limits.gate_inflation=-0.1", "training_limits.pitch_deg=60")[1]
    exact = exact_rules(MODEL, narrow).training_limits
    assert exact.gate_inflation == 0 and exact.roll_deg is None and exact.yaw_rate is None
    pitch = [each.pitch_deg for each in (limits, narrow.training_limits, exact)]
    np.testing.assert_allclose(pitch, [85, 60, 89])
    assert make_race("vehicle=5inch")[1].training_limits.pitch_deg is None  # any attitude


def test_the_gate_test_of_the_config(race, course):
    rows = level(through(1, -0.02, 0.6), 2.5 * normal(1))
    assert step(race, rows, 1)[2].crashes[GATE][0] and step(course, rows, 1)[2].passed[0]


def test_gates_may_be_wider_in_training_with_a_penalty():
    wide = make_race(
        "training_limits.gate_inflation=0.3", "reward.gate_edge=20", "reward.gate_edge_margin=0.05"
    )
    beyond = np.array([0.4, 0.7, 0.85])
    points = np.stack([through(1, -0.02, right) for right in beyond])
    rows = level(points, np.tile(5 * normal(1), (3, 1)))
    _, paid, outcome = step(wide, rows, 1)
    assert outcome.passed.tolist() == [True, True, False]
    assert outcome.crashes[GATE].tolist() == [False, False, True]
    passing = 10 - 10 * np.hypot(beyond, 0.03) - 20 * np.maximum(beyond - 0.45, 0)
    expected = [*passing[:2], -10 - 20 * 0.4]
    np.testing.assert_allclose(paid, expected, atol=1e-4)
    outcome = step((wide[0], exact_rules(wide[0].model, wide[1])), rows, 1)[2]
    assert outcome.crashes[GATE].tolist() == [False, True, True]


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


def test_starts_of_a_course():
    choices, params = make_race(*COURSE, "start.gate=random")
    states = compiled_reset(choices)(params, jax.random.key(0), 200)
    position = np.stack([*states.drone.position], axis=-1)
    for target, center in enumerate([[-3, -1.5, -1.5], *ref.GATES[:3]]):
        near = position[states.target == target] - center
        assert len(near) > 20 and np.abs(near).max() <= 0.5 + 1e-6


def test_slow_flight_near_the_ground_is_allowed_by_rule(course):
    places, speeds = [[0, 0, z] for z in (-0.3, -0.3, -0.5, 0.1, 0.6)], [4, 6, 6, 1, 1]
    _, _, outcome = step(course, level(places, [[v, 0, 0] for v in speeds]))
    np.testing.assert_array_equal(outcome.crashes[GROUND], [False, True, False, False, True])


def test_full_thrust_takes_off_from_the_ground(course):
    state = race_state("motor", level([-3, -1.5, 0], 0.0))
    for _ in range(20):
        state, _, outcome = compiled_transition(course[0])(course[1], state, np.ones((1, 4), "f"))
    assert not outcome.crashed[0] and state.drone.position.z[0] < 0


def test_flying_near_the_speed_limit_has_a_penalty():
    """A multiple of the reward for progress, above a part of the limit; its gradient is smooth."""
    plain, race = make_race(), ruled(rules__speed_limit=8)
    rows = level(through(0, -2.0), [[5.8, 0, 0], [0, 7, 0]])
    states, value, _ = step(race, rows)
    speed = np.linalg.norm([*states.drone.velocity], axis=0)
    assert speed[0] < 6.0 < speed[1] < 8.0
    expected = 5.0 * 1.0 * 0.01 * np.maximum(speed - 6.0, 0.0)
    np.testing.assert_allclose(step(plain, rows)[1] - value, expected, atol=1e-5)
    params = race[1].replace(reward=with_leaves(race[1].reward, progress=np.float32(2.0)))
    drone = state_of("motor", np.zeros(22, np.float32))

    def penalty(speed):
        after = drone.replace(velocity=Vec3(speed, 0.0 * speed, 0.0 * speed))
        return -5.0 * rewards.overspeed(Step(MODEL, params, None, None, after))

    slope = jax.jit(jax.vmap(jax.grad(penalty)))
    np.testing.assert_allclose(slope(np.float32([5.9, 6.1, -6.1])), [0.0, 10.0, -10.0], atol=1e-4)
