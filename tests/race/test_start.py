"""Where episodes begin: ranges, gates, clocks, disturbances and drawn constants."""

import jax
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from quadjax.race.episode import draw_start
from quadjax.race.track import inside_turn
from quadjax.vehicle.registry import MODELS
from tests import reference as ref
from tests.convert import rows_of
from tests.promotion import QUICK
from tests.race.support import (
    COURSE,
    compiled_reset,
    hover_state,
    make_race,
    track_of,
)

COUNT = 4000
SPREAD = (
    *("start.stagger_clocks=true", "start.gate=random"),
    *("start.along_leg=0.8", "start.position=0"),
)


def starts(*overrides):
    return drawn(*make_race(*overrides))


def drawn(environment, params, seed=0):
    state = compiled_reset(environment)(params, jax.random.key(seed), COUNT)
    return state, rows_of(state.drone)


def spans(values, low, high):
    """Whether drawn numbers fill [low, high] and no more, evenly."""
    low, high = (np.broadcast_to(x, values.shape[1:]).astype(float) for x in (low, high))
    width = high - low
    assert np.all(values.min(axis=0) >= low - 1e-5) and np.all(values.max(axis=0) <= high + 1e-5)
    assert np.all(values.min(axis=0) <= low + 0.01 * width)
    assert np.all(values.max(axis=0) >= high - 0.01 * width)
    np.testing.assert_allclose(values.mean(axis=0), 0.5 * (low + high), atol=0.03 * width.max())
    np.testing.assert_allclose(values.std(axis=0), width / np.sqrt(12), rtol=0.05)


PUBLISHED = {"position": 0.5, "velocity": 0.5, "roll_pitch_deg": 40, "yaw_deg": 180}
PUBLISHED |= {"body_rates": 1.0}
NARROW = {"position": 0.1, "velocity": 2, "roll_pitch_deg": 20, "yaw_deg": 30, "body_rates": 0.1}
DISTURBED = ("moment_x=0.03", "moment_y=0.02", "moment_z=0.01", "force_z=0.5")
RANGES = {  # overrides, half-widths, first column and range of further ones
    "motor": ((), PUBLISHED, 12, [3000.0] * 4, [11000.0] * 4),
    "rate": (("vehicle.model=rate",), PUBLISHED, 12, [7.4], [7.6]),
    "all keys": (
        (*(f"start.{k}={x}" for k, x in NARROW.items()), "vehicle.constants.rpm_min=5000"),
        *(NARROW, 12, [5000.0] * 4, [11000.0] * 4),
    ),
    "thrust": (("vehicle.model=rate", "start.thrust=[2, 9]"), PUBLISHED, 12, [2.0], [9.0]),
    "disturbances": (
        tuple(f"disturbance.{name}" for name in DISTURBED),
        *(PUBLISHED, 16, [-0.03, -0.02, -0.01, 0, 0, -0.5], [0.03, 0.02, 0.01, 0, 0, 0.5]),
    ),
}


@pytest.mark.parametrize("case", RANGES)
def test_ranges(case):
    overrides, widths, column, low, high = RANGES[case]
    state, rows = starts(*overrides)
    moved, (p, v, roll, yaw, rates) = rows.copy(), widths.values()
    moved[:, ref.P] -= ref.GATES[3]
    half = [p] * 3 + [v] * 3 + list(np.radians([roll, roll, yaw])) + [rates] * 3
    spans(moved[:, :12], np.negative(half), half)
    spans(rows[:, column : column + len(low)], low, high)
    random = rows[:, rows.std(axis=0) > 0]
    assert np.abs(np.corrcoef(random.T) - np.eye(random.shape[1])).max() < 0.08  # independent
    assert case == "disturbances" or not rows[:, 16:].any()
    for count in (state.target, state.clock, state.gates_passed):
        assert count.dtype == np.int32 and not count.any()
    assert state.constants is None


@pytest.mark.parametrize("gates", [1, 6])
def test_random_gate(gates):
    environment, params = make_race("start.gate=random")
    turn = 2 * np.pi * np.arange(gates) / gates
    centers = np.stack([9 * np.cos(turn), 9 * np.sin(turn), np.full(gates, -2.0)], 1)
    params = params.replace(track=track_of(centers, turn))
    state, rows = drawn(environment, params, seed=1)
    share = np.bincount(state.target, minlength=gates) / COUNT
    assert len(share) == gates
    np.testing.assert_allclose(share, 1 / gates, atol=4 * np.sqrt(0.25 / gates / COUNT) + 0.005)
    spans(rows[:, ref.P] - centers[(state.target - 1) % gates], -0.5, 0.5)


STRAIGHT = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [3, 2], [0, 2]], float)
SLIGHT = np.array([[0, 0.1], [0, 0], [0, 0], [0, 0.1], [0, 0], [0, 0]])
SQUARE, MIRROR = ref.GATES[:, :2], np.array([1.0, -1.0])
RIGHT = np.array([[0, 1], [-1, 0], [0, -1], [1, 0]])  # of the legs to the paper's gates
BENDS = (  # corners, legs, ways to the inside of the turn
    (SQUARE, slice(None), RIGHT),
    (SQUARE * MIRROR, slice(None), RIGHT * MIRROR),
    (STRAIGHT, 2, [1, 0]),  # between two of its own heading it looks along itself
    (STRAIGHT[:2], slice(None), [[-1, 0], [1, 0]]),
    (STRAIGHT - SLIGHT, 2, [1, 0]),  # a bend by less than 0.1 rad at each end is none
    (STRAIGHT - SLIGHT - [[0, 0.2], *[[0, 0]] * 5], 2, [0, -1]),
)


def test_the_way_into_a_bend():
    for corners, legs, ways in BENDS:
        track = track_of(np.pad(corners, ((0, 0), (0, 1))), np.zeros(len(corners)))
        yaw = np.asarray(jax.jit(inside_turn, compiler_options=QUICK)(track))
        np.testing.assert_allclose(np.stack([np.cos(yaw), np.sin(yaw)], -1)[legs], ways, atol=1e-6)


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_constants_are_drawn_by_group_and_apart_from_the_start(kind):
    groups = {"lag": 0.3, "limits": 0.1, "drag": 0.2}
    overrides = (f"randomization.{group}={width}" for group, width in groups.items())
    race = make_race(f"vehicle.model={kind}", *overrides)
    state, rows = drawn(*race)
    nominal, model = vars(race[1].vehicle.constants), MODELS[kind]
    widths = {name: x for group, x in groups.items() for name in model.groups[group]}
    for name, values in vars(state.constants).items():
        if name in widths and nominal[name] != 0:
            factors = np.asarray(values) / float(nominal[name])
            spans(factors[:, None], 1 - widths[name], 1 + widths[name])
            assert max(abs(np.corrcoef(factors, rows[:, i])[0, 1]) for i in range(12)) < 0.08
        else:
            np.testing.assert_array_equal(values, np.float32(nominal[name]))
    if kind == "motor":  # the propellers start within what this drone can do
        low, high = (np.asarray(x) for x in (state.constants.rpm_min, state.constants.rpm_max))
        spans((rows[:, ref.RPM] - low[:, None]) / (high - low)[:, None], 0.0, 1.0)


def test_hover_start():
    for kind, actuators in (("motor", 7497.0), ("rate", 9.81)):
        state = hover_state(make_race(f"vehicle.model={kind}"))
        row = rows_of(state.drone)
        np.testing.assert_allclose(row[ref.P], ref.GATES[3])
        np.testing.assert_array_equal(row[[3, 4, 5, 6, 7, 9, 10, 11]], 0.0)
        assert row[8] == pytest.approx(0.0, abs=1e-6)  # the first gate is straight north
        np.testing.assert_allclose(row[12 : 16 if kind == "motor" else 13], actuators, rtol=1e-4)
        assert state.target == 0 and state.clock == 0 and state.gates_passed == 0
    begin = hover_state(make_race("track.start={position: [0, 1, -2], yaw_deg: 200}")).drone
    np.testing.assert_allclose(begin.position.array(), [0, 1, -2])
    np.testing.assert_allclose(begin.euler.array(), [0, 0, np.radians(-160)], atol=1e-6)


def test_starts_of_a_course():
    environment, params = make_race(*COURSE, "start.gate=random")
    states = compiled_reset(environment)(params, jax.random.key(0), 200)
    position = np.stack([*states.drone.position], axis=-1)
    for target, center in enumerate([[-3, -1.5, -1.5], *ref.GATES[:3]]):
        near = position[states.target == target] - center
        assert len(near) > 20 and np.abs(near).max() <= 0.5 + 1e-6


def test_starts_along_the_way_to_the_next_gate_at_any_time():
    """From the gate before, along its yaw, up to a part of the way; each part as often."""
    state, rows = starts(*SPREAD)
    ahead = np.stack([np.cos(ref.GATE_YAW), np.sin(ref.GATE_YAW), np.zeros(4)], axis=1)
    parts, found = np.linspace(0, 0.8, 8001), []
    for target in range(4):
        ends = ref.GATES[[target - 1, target]]
        slopes = ahead[[target - 1, target]] * np.linalg.norm(ends[1] - ends[0])
        way = CubicHermiteSpline([0, 1], ends, slopes)(parts)
        distance, nearest = cKDTree(way).query(rows[state.target == target][:, ref.P])
        assert distance.max() < 1e-3
        found.append(parts[nearest])
    spans(np.concatenate(found)[:, None], [0.0], [0.8])
    spans(state.clock[:, None], [0.0], [1200.0])
    for other in (state.target, rows[:, 8]):
        assert abs(np.corrcoef(state.clock, other)[0, 1]) < 0.08


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.3, 0.5)])
def test_a_start_that_is_put_past_its_gate_is_mirrored(tilt):
    yaw = np.pi / 4 + np.pi / 2 * np.arange(4)
    track = track_of(ref.GATES, yaw, tilt=tilt)
    environment, params = make_race("start.along_leg=1", "start.gate=random", "start.position=0.5")
    state, rows = drawn(environment, params.replace(track=track))
    target, found = state.target, rows[:, ref.P]
    still = params.replace(track=track, start=params.start.replace(position=np.float32(0)))
    way = drawn(environment, still)[1][:, ref.P]
    angles = [(heading, *tilt[::-1]) for heading in yaw]
    through = Rotation.from_euler("ZYX", angles).apply([1.0, 0.0, 0.0])[state.target]
    keys = jax.random.split(jax.random.key(0), COUNT)
    moved = way + 0.5 * jax.vmap(lambda key: draw_start(environment.model, key)["position"])(keys)
    depth = np.sum((moved - ref.GATES[target]) * through, 1)
    past = (depth > 0) & (np.sum((way - ref.GATES[target]) * through, 1) < 0)
    assert past.sum() > 50
    mirrored = moved - np.where(past, 2 * depth, 0)[:, None] * through
    np.testing.assert_allclose(found, mirrored, atol=1e-4)


def test_starts_of_a_race():
    """A part of the episodes begins at rest around the start of timed laps."""
    ground = ("rules.ground_speed=5", "track.start={position: [1, -1.2, 0], yaw_deg: 20}")
    assert make_race()[1].start.race is None
    assert float(make_race(*ground)[1].start.race) == pytest.approx(0.1)
    for more, place, yaw, lowest in (
        ((), ref.GATES[3], 0.0, 7497.0),
        (ground, [1.0, -1.2, 0.0], np.radians(20), 3000.0),
    ):
        state, rows = starts("start.race=0.25", "start.gate=random", "start.velocity=0.5", *more)
        rest = np.all(rows[:, ref.V] == 0.0, axis=1)
        assert 0.22 < rest.mean() < 0.28
        assert set(state.target[rest]) == {0} and set(state.target[~rest]) == {0, 1, 2, 3}
        moved = rows[rest][:, ref.P] - place
        spans(moved[:, :2], -0.5, 0.5)
        np.testing.assert_allclose(moved[:, 2], 0.0, atol=1e-6)
        spans(rows[rest][:, 8] - yaw, -np.pi / 4, np.pi / 4)
        np.testing.assert_allclose(rows[rest][:, ref.RPM], lowest, rtol=1e-3)
