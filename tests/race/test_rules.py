"""Gates, collisions, ends of an episode and the reward, one step at a time."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import build_params, build_track, choices_of
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.race import rules
from quadjax.race.environment import exact_rules, hover_start, make_environment, transition
from quadjax.race.laps import begin, score
from quadjax.race.result import CRASHES
from quadjax.race.track import gate, make_track, to_opening_frame
from quadjax.vehicle.motor import MODEL
from tests import reference as ref
from tests.convert import rows_of, vec3
from tests.race.support import (
    HOVER,
    compiled_reset,
    compiled_transition,
    level,
    make_config,
    make_race,
    normal,
    race_state,
    step,
    through,
    track_of,
)

FLAGS = (
    "gate_collision",
    "ground",
    "out_of_bounds",
    "body_rate",
    "yaw_rate",
    "attitude",
    "non_finite",
)
FAR = np.array([0.0, 0.0, -1.5])  # in the middle of the track, away from every plane
ONE_TO_GO = np.linalg.norm(ref.GATES[1] - through(0, 0.03, 0.2))  # 3 cm beyond the first gate


@pytest.fixture(scope="module")
def race():
    return make_race()


def cross(track, target, before, after, inflation=0.0, test="square"):
    """(passed, hit) of moves between rows of positions."""
    g = gate(track, jnp.int32(target))
    before, after = (np.atleast_2d(np.asarray(x, np.float32)) for x in (before, after))
    decide = jax.vmap(lambda b, a: rules.crossing(b, a, g, jnp.float32(inflation), test))
    passed, hit = decide(vec3(before), vec3(after))
    return np.asarray(passed), np.asarray(hit)


@pytest.mark.parametrize("target", range(4))
@pytest.mark.parametrize("test", ["square", "world_box", "interpolated"])
def test_each_gate_is_passed_forwards_only(target, test):
    track = track_of(ref.GATES, ref.GATE_YAW)
    behind, ahead = through(target, -0.05), through(target, 0.05)
    assert cross(track, target, behind, ahead, 0, test) == (True, False)
    assert cross(track, target, ahead, behind, 0, test) == (False, False)
    assert cross(track, target, through(target, -0.1), behind, 0, test) == (False, False)
    assert cross(track, target, ahead, through(target, 0.1), 0, test) == (False, False)


@pytest.mark.parametrize("target", range(4))
@pytest.mark.parametrize("inflation", [0.0, -0.1, 0.3])
def test_inside_the_square_passes_and_outside_collides(target, inflation):
    track, edge = track_of(ref.GATES, ref.GATE_YAW), 0.5 + inflation
    for right, down in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1)]:
        for offset, passes in [(edge - 0.01, True), (edge + 0.01, False)]:
            before = through(target, -0.05, offset * right, offset * down)
            after = through(target, 0.05, offset * right, offset * down)
            assert cross(track, target, before, after, inflation) == (passes, not passes)


def test_gates_have_their_own_width_and_height():
    track = track_of(np.array([[0, 0, -2.0]]), np.zeros(1), size=(2.0, 0.6))
    for right, down, passes in [
        (0.9, 0, True),
        (1.1, 0, False),
        (0, 0.25, True),
        (0, -0.35, False),
    ]:
        move = [-0.05, right, -2 + down], [0.05, right, -2 + down]
        assert cross(track, 0, *move) == (passes, not passes)
        assert cross(track, 0, *move, test="world_box") == (passes, not passes)


def test_the_plane_itself_counts_as_past_it():
    track = track_of(np.array([[0, 0, -2.0]]), np.zeros(1))
    assert cross(track, 0, [-0.1, 0, -2], [0.0, 0, -2]) == (True, False)
    assert cross(track, 0, [0.0, 0, -2], [0.1, 0, -2]) == (False, False)


def test_world_box_is_measured_in_world_axes():
    """At 45 deg the box's corner reaches 0.707 m sideways, where the square ends at 0.5 m."""
    track = track_of(ref.GATES, ref.GATE_YAW)
    for right, square, box in [(0.4, True, True), (0.6, False, True), (0.75, False, False)]:
        move = through(0, -0.05, right), through(0, 0.001, right)
        assert cross(track, 0, *move) == (square, not square)
        assert cross(track, 0, *move, test="world_box") == (box, not box)
    low = through(0, -0.05, 0, 0.51), through(0, 0.001, 0, 0.51)
    assert cross(track, 0, *low, test="world_box") == (False, True)
    straight = track_of(np.array([[0, 0, -2.0]]), np.zeros(1))
    assert cross(straight, 0, [-0.2, 0, -2], [0.49, 0, -2], test="world_box") == (True, False)
    assert cross(straight, 0, [-0.2, 0, -2], [0.51, 0, -2], test="world_box") == (False, True)
    assert cross(straight, 0, [-0.2, 0, -2], [0.51, 0, -2]) == (True, False)
    assert cross(straight, 0, [-0.2, 0, -2], [0.3, 0, -2], -0.3, "world_box") == (False, True)


@pytest.mark.parametrize(
    ("before", "after", "sampled", "crossing"),
    [  # at 45 deg to the plane, 0.1 m a step: the sample past it is up to 7 cm further aside
        ((-0.01, 0.47), (0.06, 0.54), False, True),
        ((-0.06, 0.53), (0.01, 0.46), True, True),
        ((-0.01, 0.57), (0.06, 0.48), True, False),
        ((-0.035, 0.40), (0.035, 0.47), True, True),
        ((-0.035, 0.55), (0.035, 0.62), False, False),
    ],
)
def test_interpolated_crossing_is_where_the_line_meets_the_plane(before, after, sampled, crossing):
    track = track_of(ref.GATES, ref.GATE_YAW)
    ends = through(1, *before), through(1, *after)
    fraction = before[0] / (before[0] - after[0])
    assert (abs(before[1] + fraction * (after[1] - before[1])) < 0.5) == crossing
    assert cross(track, 1, *ends) == (sampled, not sampled)
    assert cross(track, 1, *ends, test="interpolated") == (crossing, not crossing)


def test_a_body_narrows_openings_hall_and_height():
    """A sphere of 0.2 m: every solid thing is closer by its radius."""
    keys = (
        "rules.gate_frame=0.4",
        "rules.gate_depth=0.2",
        "rules.bounds=[[-4, 4], [-4, 4], [-3, 0]]",
    )
    race = make_race("rules.body_radius=0.2", *keys)
    offsets = [0.29, 0.31, -0.29, -0.31, 0.0, 0.32]
    rows = level([through(0, -0.03, x) for x in offsets], 0.0)
    rows[:, ref.V] = 5.0 * normal(0)
    _, _, outcome = step(race, rows, target=0)
    np.testing.assert_array_equal(outcome.passed, [True, False, True, False, True, False])
    np.testing.assert_array_equal(outcome.gate_collision, ~outcome.passed)
    frames = [(0.0, 0.29), (0.0, 0.31), (0.29, 0.6), (0.31, 0.6), (0.0, 1.09), (0.0, 1.11)]
    rows = level([through(2, *offset) for offset in frames], 0.0)
    _, _, outcome = step(race, rows, target=0)
    np.testing.assert_array_equal(outcome.gate_collision, [False, True, True, False, True, False])
    places = [
        [3.79, 0, -1],
        [3.81, 0, -1],
        [0, 0, -2.79],
        [0, 0, -2.81],
        [0, 0, -0.21],
        [0, 0, -0.19],
    ]
    _, _, outcome = step(race, level(places, 0.0), target=0)
    np.testing.assert_array_equal(outcome.out_of_bounds, [False, True, False, True, False, True])
    np.testing.assert_array_equal(outcome.ground, [False] * 5 + [True])


def test_a_body_larger_than_the_opening_is_refused():
    with pytest.raises(InputError, match=r"track.gates\[0\].size is .* above 1 .*body_radius 0.5"):
        make_config("rules.body_radius=0.5")


@pytest.mark.parametrize("target", range(4))
def test_passing_advances_the_target_and_wraps_round(race, target):
    rows = level(through(target, -0.02, 0.1, -0.2), 5 * normal(target))
    following, value, outcome = step(race, rows, target, clock=7)
    assert outcome.passed[0] and not outcome.terminated[0] and not outcome.truncated[0]
    assert following.target[0] == (target + 1) % 4
    assert following.gates_passed[0] == 1 and following.step[0] == 8
    offset = np.linalg.norm([0.03, 0.1, 0.2])
    assert value[0] == pytest.approx(10 - 10 * offset, abs=1e-4)


@pytest.mark.parametrize("target", range(4))
def test_missing_the_opening_is_a_collision(race, target):
    rows = level(through(target, -0.02, 0.6), 5 * normal(target))
    following, value, outcome = step(race, rows, target)
    assert flags(outcome, 0) == {"gate_collision"} and not outcome.passed[0]
    assert following.target[0] == target and following.gates_passed[0] == 0
    assert value[0] == -10


def test_only_the_target_gate_counts(race):
    rows = level(np.stack([through(0, -0.02), through(0, -0.02, 0.6)]), 5 * normal(0))
    following, value, outcome = step(race, rows, target=2)
    assert not np.any(outcome.passed) and not np.any(outcome.terminated)
    np.testing.assert_array_equal(following.target, 2)
    assert np.all(np.abs(value) <= 0.05 + 1e-6)


@pytest.mark.parametrize("count", [1, 2, 4, 6, 20])
def test_any_number_of_gates(race, count):
    """Round a circle of gates, through each in turn and back to the first."""
    turn = 2 * np.pi * np.arange(count) / count
    gates = np.stack([4 * np.cos(turn), 4 * np.sin(turn), np.full(count, -2.0)], 1)
    params = race[1].replace(track=track_of(gates, turn + np.pi / 2))
    ahead = np.stack([-np.sin(turn), np.cos(turn), 0 * turn], 1)
    rows = level(gates - 0.02 * ahead, 5 * ahead)
    following, _, outcome = step((race[0], params), rows, target=np.arange(count))
    assert np.all(outcome.passed)
    np.testing.assert_array_equal(following.target, (np.arange(count) + 1) % count)


def flags(outcome, index):
    return {name for name in FLAGS if bool(getattr(outcome, name)[index])}


def test_every_way_to_crash(race):
    """The ground, the four walls and the attitude; close to each limit, and no other flag."""
    _, params = race
    limits = params.limits.replace(pitch=jnp.float32(1.0), roll=jnp.float32(1.5))
    race = (race[0], params.replace(limits=limits))
    cases = []

    def case(expected, position=FAR, velocity=(0, 0, 0), **columns):
        row = level(position, np.asarray(velocity, float))[0]
        for column, value in columns.items():
            row[int(column[1:])] = value
        cases.append((expected, row))

    case(set())
    case({"ground"}, [0, 0, -0.02], [0, 0, 5])
    case(set(), [0, 0, -0.08], [0, 0, 5])
    case(set(), [0, 0, -60], [0, 0, -5])
    for axis in (0, 1):
        for sign in (1, -1):
            move = sign * np.eye(3)[axis]
            case({"out_of_bounds"}, FAR + 9.98 * move, 5 * move)
            case(set(), FAR + 9.9 * move, 5 * move)
    for column in ("c9", "c10", "c11"):
        for sign in (1, -1):
            case({"body_rate"}, **{column: sign * 1010.0})
            case(set(), **{column: sign * 900.0})
    for column, limit in (("c6", 1.5), ("c7", 1.0)):
        for sign in (1, -1):
            case({"attitude"}, **{column: sign * (limit + 0.01)})
            case(set(), **{column: sign * (limit - 0.01)})
    expected, rows = zip(*cases, strict=True)
    rows = np.stack(rows)
    # High rates turn the drone within the step, which is not what is asked here.
    limits = limits.replace(roll=jnp.float32(1e3), pitch=jnp.float32(1e3))
    fast = np.abs(rows[:, ref.RATES]).max(axis=1) > 100
    for chosen, bound in ((~fast, race[1].limits), (fast, limits)):
        params = race[1].replace(limits=bound)
        following, value, outcome = step((race[0], params), rows[chosen], target=1)
        for index, wanted in enumerate(np.array(expected, object)[chosen]):
            assert flags(outcome, index) == wanted, rows[chosen][index]
            assert bool(outcome.terminated[index]) == bool(wanted)
            assert (float(value[index]) == -10) == bool(wanted)
        np.testing.assert_array_equal(following.target, 1)


def test_a_crash_at_the_gate_is_no_pass(race):
    """Through the opening, but below the ground, in a gate that reaches into it."""
    track = track_of(np.array([[0, 0, -0.2]]), np.zeros(1))
    rows = level(np.array([-0.02, 0, 0.1]), np.array([5.0, 0, 0]))
    following, value, outcome = step((race[0], race[1].replace(track=track)), rows)
    assert flags(outcome, 0) == {"ground"} and not outcome.passed[0]
    assert following.gates_passed[0] == 0 and value[0] == -10


def test_truncation_is_not_termination(race):
    rows = np.repeat(level(FAR, np.zeros(3)), 3, axis=0)
    rows[2, 2], rows[2, 5] = -0.01, 5.0
    _, value, outcome = step(race, rows, clock=np.array([1198, 1199, 1199]))
    np.testing.assert_array_equal(outcome.truncated, [False, True, False])
    np.testing.assert_array_equal(outcome.terminated, [False, False, True])
    assert float(value[1]) == pytest.approx(float(value[0]), abs=1e-6) and value[2] == -10


@pytest.mark.parametrize("kind", ["motor", "rate"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_state_that_is_not_finite_is_a_crash_and_nothing_more(kind, bad):
    race = make_race(f"vehicle.model={kind}", "reward.body_rates=0.1", "reward.time=0.2")
    rows = ref.random_states(kind, 4)
    rows[:, ref.P], rows[:, ref.RATES] = FAR, 0.5
    velocity = rows.copy()
    velocity[1, 3] = 3e38  # its square is not finite, nor is its drag
    velocity[1, 6:9] = 0.3
    action = np.full((4, 4), 0.1, np.float32)
    action[2, 3] = bad
    following, value, outcome = step(race, velocity, action=action, kind=kind)
    state = rows_of(following.drone)
    assert np.all(np.isfinite(state[[0, 2, 3]])) and np.all(
        np.isfinite(value[jnp.array([0, 2, 3])])
    )
    if np.isnan(bad):
        assert flags(outcome, 2) == {"non_finite"} and outcome.terminated[2]
        np.testing.assert_array_equal(state[2], velocity[2].astype(np.float32))
        assert value[2] == pytest.approx(-10 - 0.01 * (0.2 + 0.1 * np.sqrt(0.75)), rel=1e-5)
    else:  # an infinite action is a saturated one
        assert not outcome.terminated[2]
    assert not outcome.non_finite[0] and not outcome.non_finite[3]
    if kind == "motor":
        assert outcome.non_finite[1] and outcome.terminated[1]
        np.testing.assert_array_equal(state[1], velocity[1].astype(np.float32))


def weights(**kept):
    fields = dataclasses.fields(rules.RewardWeights)
    zeros = {field.name: 0.0 for field in fields if field.default is dataclasses.MISSING}
    zeros |= {"gate_edge_reach": 1.0} | kept
    return rules.RewardWeights(**{name: jnp.float32(value) for name, value in zeros.items()})


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
    assert outcome.passed[1] and outcome.gate_collision[2]
    np.testing.assert_allclose(value, expected, atol=2e-5)


@pytest.mark.parametrize("target", range(4))
@pytest.mark.parametrize(("right", "down"), [(0, 0), (0.45, 0), (-0.3, 0.4), (0.2, -0.45)])
def test_next_gate_progress_rewards_a_leg_the_same_wherever_its_gate_is_passed(target, right, down):
    track = track_of(ref.GATES, ref.GATE_YAW)
    following, kinds = (target + 1) % 4, weights(progress=1.0, next_gate_progress=1.0)
    points = [through(target, -0.7), through(target, -0.06, right, down)]
    points += [through(target, 0.02, right, down), through(following, -0.5)]
    flown = [vec3(np.atleast_2d(p).astype(np.float32)) for p in points]
    passing = [False, True, False]
    targets = [target, target, following]
    paid = 0.0
    for before, after, index, passed in zip(flown, flown[1:], targets, passing, strict=False):
        outcome = rules.Outcome(*[jnp.zeros(1, bool)] * 9).replace(passed=jnp.array([passed]))
        g = gate(track, jnp.int32(index))
        pitch, dt = jnp.zeros(1), jnp.float32(0.01)
        paid += rules.reward(kinds, outcome, before, after, pitch, before, g, dt)[0]
    way = np.linalg.norm(ref.GATES[following] - ref.GATES[target])
    assert float(paid) == pytest.approx(0.7 + way - 0.5, abs=1e-5)


def test_default_reward_is_the_published_one(race):
    values = vars(race[1].reward)
    absent = {"action_change", "perception", "overspeed"}
    assert {name for name, x in values.items() if x is None} == absent
    assert {name: float(x) for name, x in values.items() if x is not None} == {
        "progress": 1.0,
        "gate": 10.0,
        "gate_offset": 10.0,
        "next_gate_progress": 0.0,
        "collision": 10.0,
        "time": 0.0,
        "body_rates": 0.0,
        "pitch_up": 0.0,
        "gate_edge": 0.0,
        "gate_edge_margin": pytest.approx(0.1),
        "gate_edge_reach": 1.0,
    }


def test_a_roll_has_no_end():
    """Upside down is no crash: the angle goes on from the other side."""
    race = make_race()
    rows = level(through(0, -2.0), 0.0)
    rows[:, ref.EULER], rows[:, ref.RATES] = [np.pi - 0.01, 0, 0], [5.0, 0, 0]
    for choices, params in (race, (race[0], exact_rules(race[0].model, race[1]))):
        states, _, outcome = step((choices, params), rows)
        assert not outcome.terminated[0]
        np.testing.assert_allclose(states.drone.euler.x[0], 0.04 - np.pi, atol=2e-3)


def test_spinning_ends_an_episode_in_training_alone():
    """A yaw rate beyond the limit of a config, either way round; by the exact rules it is none."""
    choices, params = make_race("training_limits.yaw_rate=5")
    rows = level(through(0, -2.0), 0.0)
    for rate, ends in ((4.5, False), (6.0, True), (-6.0, True)):
        rows[:, ref.RATES] = [0.0, 0.0, rate]
        assert bool(step((choices, params), rows)[2].yaw_rate[0]) == ends
        assert not step((choices, exact_rules(choices.model, params)), rows)[2].terminated[0]


def test_default_limits_are_the_published_ones(race):
    values = vars(race[1].limits)
    limits = {name: float(x) for name, x in values.items() if x is not None}
    assert set(values) - set(limits) == {
        "bounds",
        "frame",
        "landing",
        "body_radius",
        "axis_rates",
        "speed",
    }  # none
    assert limits["time_step"] == pytest.approx(0.01) and limits["episode_steps"] == 1200
    assert (
        limits["position"] == 10 and limits["body_rate"] == 1000 and limits["gate_inflation"] == 0
    )
    exact = exact_rules(
        MODEL, make_race("training_limits.gate_inflation=-0.1", "training_limits.pitch_deg=60")[1]
    )
    assert float(exact.limits.gate_inflation) == 0
    assert float(exact.limits.pitch) == pytest.approx(np.radians(89))
    assert float(exact.limits.roll) > np.pi
    assert np.isinf(float(exact.limits.yaw_rate)) and np.isinf(limits["yaw_rate"])


def test_gate_inflation_of_the_config(race):
    narrow = make_race("training_limits.gate_inflation=-0.1")
    rows = level(through(1, -0.02, 0.45), 5 * normal(1))
    assert step(race, rows, 1)[2].passed[0] and step(narrow, rows, 1)[2].gate_collision[0]
    box = make_race("rules.gate_test=world_box")
    rows = level(through(1, -0.02, 0.6), 2.5 * normal(1))
    assert step(race, rows, 1)[2].gate_collision[0] and step(box, rows, 1)[2].passed[0]


def test_gates_may_be_wider_in_training_with_a_penalty():
    wide = make_race(
        "training_limits.gate_inflation=0.3", "reward.gate_edge=20", "reward.gate_edge_margin=0.05"
    )
    beyond = np.array([0.4, 0.7, 0.85])
    points = np.stack([through(1, -0.02, right) for right in beyond])
    rows = level(points, np.tile(5 * normal(1), (3, 1)))
    _, paid, outcome = step(wide, rows, 1)
    assert outcome.passed.tolist() == [True, True, False]
    assert outcome.gate_collision.tolist() == [False, False, True]
    passing = 10 - 10 * np.hypot(beyond, 0.03) - 20 * np.maximum(beyond - 0.45, 0)
    expected = [*passing[:2], -10 - 20 * 0.4]
    np.testing.assert_allclose(paid, expected, atol=1e-4)
    outcome = step((wide[0], exact_rules(wide[0].model, wide[1])), rows, 1)[2]
    assert outcome.gate_collision.tolist() == [False, True, True]


def test_yaw_stays_wrapped(race):
    rows = np.repeat(level(FAR, np.zeros(3)), 2, axis=0)
    rows[:, 8], rows[:, 11] = [3.14, -3.14], [10.0, -10.0]
    yaw = rows_of(step(race, rows)[0].drone)[:, 8]
    np.testing.assert_allclose(yaw, [3.24 - 2 * np.pi, 2 * np.pi - 3.24], atol=1e-4)


def test_one_compilation_serves_every_set_of_numbers(race):
    compiled = compiled_transition(race[0])
    before = compiled._cache_size()
    changed = make_race(
        "vehicle.constants.k_w=5e-8", "reward.gate=1", "training_limits.episode_steps=300"
    )[1]
    state = race_state("motor", level(FAR, np.zeros(3)))
    compiled(race[1], state, jnp.full((1, 4), HOVER, jnp.float32))
    after = compiled._cache_size()
    compiled(changed, state, jnp.full((1, 4), HOVER, jnp.float32))
    assert compiled._cache_size() == after and after - before <= 1


COURSE = ("track.closed=false", "track.start={position: [-3, -1.5, -1.5]}", "evaluate.laps=1")
TILTS = np.radians([[30.0, 0.0], [0.0, -90.0], [-20.0, 70.0]])  # roll, pitch


@pytest.mark.parametrize("circle", [False, True])
def test_tilted_and_round_openings(circle):
    """Moves across each opening's plane, against rotation matrices."""
    yaw, size = np.array([0.3, -2.0, 1.0]), (1.4, 1.4 if circle else 0.8)
    centers = np.array([[1.0, 2, -3], [-2, 0, -2], [0, 3, -4]])
    arrays = [jnp.asarray(x, jnp.float32) for x in (centers, yaw, np.tile(size, (3, 1)), TILTS)]
    track = make_track(*arrays, circle=jnp.full(3, circle))
    draw = np.random.default_rng(0)
    for index, matrix in enumerate(ref.rotation(np.column_stack([TILTS, yaw]))):
        after = draw.uniform(-1.2, 1.2, (400, 3)) * [0.1, 1, 1]
        before = after - np.array([0.1, 0, 0])
        world = [local @ matrix.T + centers[index] for local in (before, after)]
        passed, hit = cross(track, index, *world)
        crossed = (before[:, 0] < 0) & (after[:, 0] >= 0)
        inside = np.all(np.abs(after[:, 1:]) <= np.array(size) / 2, axis=1)
        if circle:
            inside = np.hypot(*after[:, 1:].T) <= 0.7
        np.testing.assert_array_equal(passed, crossed & inside)
        np.testing.assert_array_equal(hit, crossed & ~inside)
        assert passed.sum() > 30 and hit.sum() > 30
        g = gate(track, jnp.int32(index))
        found = jax.vmap(lambda a, g=g: rules.clearance_violation(a, g, jnp.float32(0.1)))(
            vec3(np.float32(world[1]))
        )
        beyond = np.clip(np.abs(after[:, 1:]) - np.array(size) / 2 + 0.1, 0, 1).sum(axis=1)
        if circle:
            beyond = np.clip(np.hypot(*after[:, 1:].T) - 0.6, 0, 2)
        np.testing.assert_allclose(found, beyond, atol=1e-5)


def test_tilt_and_shape_of_a_config():
    """A gate to dive through: the passage points down, the opening's height to the front."""
    below = "{position: [0, 0, -2], pitch_deg: -90, size: [2, 2], shape: circle}"
    config = make_config(f"track.gates=[{below}, {{position: [1, 0, -1]}}]")
    track = build_track(config.track)
    g = gate(track, jnp.int32(0))
    down = to_opening_frame(g, Vec3(*jnp.float32([0.0, 0.0, 1.0])))
    np.testing.assert_allclose(down.array(), [1, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(track.circle, [True, False])
    for index, own in enumerate(config.track.gates):
        x, y, z = (to_opening_frame(gate(track, jnp.int32(index)), Vec3.of(e)) for e in jnp.eye(3))
        np.testing.assert_allclose([x.array(), y.array(), z.array()], own.axes, atol=1e-6)
    assert build_track(make_config().track).opening is None
    for override, message in (
        ("rules.gate_test=world_box", "allowed: square, because track.gates[0] is tilted or round"),
        ("track.gates=[{position: [0, 0, -2], size: [2, 1], shape: circle}]", "of a circle"),
    ):
        with pytest.raises(InputError) as error:
            make_config(f"track.gates=[{below}]", override)
        assert message in str(error.value)


def test_frames_of_all_gates_are_solid():
    """A position in the frame of a gate that is not the target ends the episode."""
    frames = ("rules.gate_frame=0.4", "rules.gate_depth=0.2")
    offsets = [(0.0, 0.3), (0.0, 0.6), (0.09, -0.8), (0.0, 1.0), (0.12, 0.6), (-0.09, 0.6)]
    solid = [False, True, True, False, False, True]
    rows = level([through(2, *offset) for offset in offsets], 0.0)
    _, _, outcome = step(make_race(*frames), rows, target=0)
    np.testing.assert_array_equal(outcome.gate_collision, solid)
    _, _, outcome = step(make_race(*frames, "training_limits.gate_inflation=0.2"), rows, target=0)
    np.testing.assert_array_equal(outcome.gate_collision, [*solid[:1], False, *solid[2:5], False])


def test_bounds_of_the_hall():
    race = make_race("rules.bounds=[[-3, 4], [-2.5, 2], [-5, 0]]")
    inside = [[-2.9, 0, -2], [3.9, 0, -2], [0, -2.4, -2], [0, 1.9, -2], [0, 0, -4.9]]
    beyond = [[-3.1, 0, -2], [4.1, 0, -2], [0, -2.6, -2], [0, 2.1, -2], [0, 0, -5.1]]
    _, _, outcome = step(race, level([*inside, *beyond], 0.0))
    np.testing.assert_array_equal(outcome.out_of_bounds, [False] * 5 + [True] * 5)


def test_start_of_timed_laps():
    config = make_config("track.start={position: [0, 1, -2], yaw_deg: 200}")
    begin = hover_start(choices_of(config), build_params(config)).drone
    np.testing.assert_allclose(begin.position.array(), [0, 1, -2])
    np.testing.assert_allclose(begin.euler.array(), [0, 0, np.radians(-160)], atol=1e-6)
    assert load_config("e2e", ["track=figure8_tudelft"]).track.start.position == (1.5, -2.5, -1.5)
    assert load_config("e2e", ["track=square4"]).track.start is None


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("track.start={position: [0, 0, 0]}",),
            "track.start.position is [0.0, 0.0, 0.0]",
        ),
        (("rules.bounds=[[-1, 4], [-2, 2], [-5, 0]]",), "within rules.bounds"),
        (("track.closed=false", "evaluate.laps=1"), "track.start is None, allowed"),
        (COURSE[:2], "evaluate.laps is 6, allowed: 1 with track.closed false"),
        (("rules.gate_depth=0.2",), "rules.gate_depth is 0.2, allowed: 0.1 without rules.gate_fr"),
    ],
)
def test_impossible_rules_of_a_track(overrides, message):
    with pytest.raises(InputError) as error:
        make_config(*overrides)
    assert message in str(error.value)


def test_a_course_ends_with_its_last_gate():
    race = make_race(*COURSE)
    rows = np.concatenate([level([through(index, -0.01)], 5.0 * normal(index)) for index in (2, 3)])
    following, value, outcome = step(race, rows, target=[2, 3])
    np.testing.assert_array_equal(outcome.passed, [True, True])
    np.testing.assert_array_equal(outcome.finished, [False, True])
    np.testing.assert_array_equal(outcome.terminated, [False, False])
    assert np.all(value > 0)
    ahead = gate(race[1].track, jnp.int32(3))
    np.testing.assert_allclose(ahead.next_position.array(), [5, 0, 0], atol=1e-6)
    assert float(ahead.next_yaw) == 0
    state = jax.tree.map(lambda x: x[1], race_state("motor", rows, [2, 3]))
    _, _, ended, truncated = make_environment(race[0]).step(race[1], state, jnp.zeros(4))
    assert bool(ended) and not bool(truncated)
    scored = score(
        begin(race_state("motor", rows, [2, 3]), 1).replace(lap_end=jnp.zeros((1, 2))),
        following,
        outcome,
        jnp.float32(0.01),
        4,
    )
    np.testing.assert_allclose(scored.lap_end, [[0.0, 0.01]])
    np.testing.assert_array_equal(scored.over, [False, True])


def test_starts_of_a_course():
    choices, params = make_race(*COURSE, "start.gate=random")
    states = compiled_reset(choices)(params, jax.random.split(jax.random.key(0), 200))
    position = states.drone.position.array()
    for target, center in enumerate([[-3, -1.5, -1.5], *ref.GATES[:3]]):
        near = np.asarray(position)[np.asarray(states.target) == target] - center
        assert len(near) > 20 and np.abs(near).max() <= 0.5 + 1e-6


def test_slow_flight_near_the_ground_is_allowed_by_rule():
    race = make_race("rules.ground_speed=5", "rules.ground_height=0.4")
    places, speeds = (
        [[0, 0, -0.3], [0, 0, -0.3], [0, 0, -0.5], [0, 0, 0.1], [0, 0, 0.6]],
        [4, 6, 6, 1, 1],
    )
    _, _, outcome = step(race, level(places, [[v, 0, 0] for v in speeds]))
    np.testing.assert_array_equal(outcome.ground, [False, True, False, False, True])


def test_a_track_with_rules_and_a_start_on_the_ground():
    config = load_config(
        "e2e_shac", ["track=grand_challenge", "vehicle=a2rl", "rules.gate_frame=0.5"]
    )
    assert config.rules.position_limit is None and config.rules.ground_speed == 10
    assert config.rules.gate_frame == 0.5
    choices, params = choices_of(config), build_params(config)
    begin = hover_start(choices, params).drone
    np.testing.assert_allclose(begin.position.array(), [8, -22, 0])
    np.testing.assert_allclose(begin.rotors.array(), 341.75)
    step_once = jax.jit(functools.partial(transition, choices))
    state = hover_start(choices, params)
    for _ in range(20):  # full thrust takes off
        state, _, outcome = step_once(params, state, jnp.ones(4))
    assert not outcome.terminated and float(state.drone.position.z) < 0


def test_a_speed_limit_ends_training_and_races():
    race = make_race("rules.speed_limit=8", "start.velocity=0.5")
    rows = level(through(0, -2.0), [[7.9, 0, 0], [0, 6, -6]])
    for choices, params in (race, (race[0], exact_rules(race[0].model, race[1]))):
        following, _, outcome = step((choices, params), rows)
        np.testing.assert_array_equal(outcome.overspeed, [False, True])
        np.testing.assert_array_equal(outcome.terminated, [False, True])
    assert step(make_race(), rows)[2].overspeed is None
    before = begin(race_state("motor", rows), 1)
    scored = score(before, following, outcome, jnp.float32(0.01), 4)
    assert [CRASHES[code] for code in scored.crash] == ["", "above the speed limit"]


def test_each_limit_of_the_rates_and_the_attitude_has_its_own_text():
    race = make_race(
        "rules.body_rate_limit=5", "training_limits.yaw_rate=3", "training_limits.roll_deg=80"
    )
    rows = level(np.tile(FAR, (4, 1)), 0.0)
    rows[0, ref.RATES], rows[1, ref.RATES] = [6, 0, 0], [0, 0, 4]
    rows[2, 6], rows[3, ref.P] = 1.5, [99, 0, -1]
    following, _, outcome = step(race, rows)
    scored = score(begin(race_state("motor", rows), 1), following, outcome, jnp.float32(0.01), 4)
    assert [CRASHES[code] for code in scored.crash] == [
        "above the body rate limit",
        "above the training limit of the yaw rate",
        "lost its attitude",
        "out of bounds",
    ]


def test_flying_near_the_speed_limit_has_a_penalty():
    """A multiple of the reward for progress, above a part of the limit; its gradient is smooth."""
    plain = make_race()
    race = make_race("rules.speed_limit=8", "reward.overspeed=5", "reward.overspeed_margin=0.25")
    rows = level(through(0, -2.0), [[5.8, 0, 0], [0, 7, 0]])
    states, value, _ = step(race, rows)
    speed = np.linalg.norm(states.drone.velocity.array(), axis=-1)
    assert speed[0] < 6.0 < speed[1] < 8.0
    expected = 5.0 * 1.0 * 0.01 * np.maximum(speed - 6.0, 0.0)
    np.testing.assert_allclose(step(plain, rows)[1] - value, expected, atol=1e-5)
    slope = jax.grad(
        lambda v: rules.overspeed_penalty(race[1].reward.overspeed, 2.0, Vec3(v, 0.0 * v, 0.0 * v))
    )
    np.testing.assert_allclose([slope(5.9), slope(6.1), slope(-6.1)], [0.0, 10.0, -10.0], atol=1e-4)
