"""Where episodes begin: ranges, gates, clocks, disturbances and drawn constants."""

import jax
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree

from quadjax.config.race import choices_of
from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.flights import Flight, Signal, load, save
from quadjax.flights.files import LIMIT
from quadjax.flights.flight import MOTION
from quadjax.race.episode import draw_constants
from quadjax.race.track import inside_turn
from quadjax.training.build import training_params
from quadjax.training.inputs import states_of
from quadjax.vehicle.registry import MODELS
from tests import reference as ref
from tests.convert import rows_of
from tests.promotion import QUICK
from tests.race.support import (
    compiled_reset,
    hover_state,
    make_config,
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


def drawn(choices, params, seed=0):
    state = compiled_reset(choices)(params, jax.random.key(seed), COUNT)
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


def independent(rows, columns):
    """Whether no two drawn columns go together."""
    correlation = np.corrcoef(rows[:, columns].T) - np.eye(len(columns))
    assert np.max(np.abs(correlation)) < 0.08


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_ranges(kind):
    state, rows = starts(f"vehicle.model={kind}")
    spans(rows[:, ref.P] - ref.GATES[3], -0.5, 0.5)
    spans(rows[:, ref.V], -0.5, 0.5)
    angle = np.radians([40.0, 40.0, 180.0])
    spans(rows[:, ref.EULER], -angle, angle)
    spans(rows[:, ref.RATES], -1.0, 1.0)
    if kind == "motor":
        spans(rows[:, ref.RPM], 3000.0, 11000.0)
        np.testing.assert_array_equal(rows[:, 16:], 0.0)
    else:
        spans(rows[:, ref.THRUST], 7.4, 7.6)
    independent(rows, list(range(16 if kind == "motor" else 13)))
    for count in (state.target, state.step, state.gates_passed):
        assert count.dtype == np.int32
        np.testing.assert_array_equal(count, 0)
    assert state.constants is None


def test_each_range_of_the_config():
    _, rows = starts(
        "start.position=0.1",
        "start.velocity=2",
        "start.roll_pitch_deg=20",
        "start.yaw_deg=30",
        "start.body_rates=0.1",
        "vehicle.constants.rpm_min=5000",
    )
    spans(rows[:, ref.P] - ref.GATES[3], -0.1, 0.1)
    spans(rows[:, ref.V], -2, 2)
    angle = np.radians([20.0, 20.0, 30.0])
    spans(rows[:, ref.EULER], -angle, angle)
    spans(rows[:, ref.RATES], -0.1, 0.1)
    spans(rows[:, ref.RPM], 5000.0, 11000.0)
    _, rows = starts("vehicle.model=rate", "start.thrust=[2, 9]")
    spans(rows[:, ref.THRUST], 2.0, 9.0)


def test_disturbances():
    names = ("moment_x=0.03", "moment_y=0.02", "moment_z=0.01", "force_z=0.5")
    _, rows = starts(*(f"disturbance.{name}" for name in names))
    spans(rows[:, ref.MOMENT], [-0.03, -0.02, -0.01], [0.03, 0.02, 0.01])
    spans(rows[:, 21:22], -0.5, 0.5)
    np.testing.assert_array_equal(rows[:, 19:21], 0.0)
    independent(rows, [0, 5, 8, 11, 12, 15, 16, 17, 18, 21])


@pytest.mark.parametrize("gates", [1, 6])
def test_random_gate(gates):
    choices, params = make_race("start.gate=random")
    turn = 2 * np.pi * np.arange(gates) / gates
    centres = np.stack([9 * np.cos(turn), 9 * np.sin(turn), np.full(gates, -2.0)], 1)
    params = params.replace(track=track_of(centres, turn))
    state, rows = drawn(choices, params, seed=1)
    target = state.target
    share = np.bincount(target, minlength=gates) / COUNT
    assert len(share) == gates
    np.testing.assert_allclose(share, 1 / gates, atol=4 * np.sqrt(0.25 / gates / COUNT) + 0.005)
    offset = rows[:, ref.P] - centres[(target - 1) % gates]
    spans(offset, -0.5, 0.5)


def way_inside_turn(corners):
    """Unit vectors, (gates, 2), of a track of gates at the corners."""
    track = track_of(np.pad(corners, ((0, 0), (0, 1))), np.zeros(len(corners)))
    yaw = np.asarray(jax.jit(inside_turn, compiler_options=QUICK)(track))
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def test_the_way_into_a_bend():
    """Across each leg of a rectangle, to the right where that is flown clockwise, as from above."""
    right = np.array([[0, 1], [-1, 0], [0, -1], [1, 0]])  # of the legs to the paper's gates
    corners, mirror = ref.GATES[:, :2], np.array([1.0, -1.0])
    np.testing.assert_allclose(way_inside_turn(corners), right, atol=1e-6)
    np.testing.assert_allclose(way_inside_turn(corners * mirror), right * mirror, atol=1e-6)


def test_a_leg_without_a_bend():
    """Between two of its own heading it looks along itself, and so does each leg of two gates.

    A bend by less than 0.1 rad at each end is none. One gate has a leg of no length.
    """
    corners = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [3, 2], [0, 2]], float)
    np.testing.assert_allclose(way_inside_turn(corners)[2], [1, 0], atol=1e-6)
    np.testing.assert_allclose(way_inside_turn(corners[:2]), [[-1, 0], [1, 0]], atol=1e-6)
    slight = corners - np.array([[0, 0.1], [0, 0], [0, 0], [0, 0.1], [0, 0], [0, 0]])
    np.testing.assert_allclose(way_inside_turn(slight)[2], [1, 0], atol=1e-6)
    np.testing.assert_allclose(
        way_inside_turn(slight - [[0, 0.2], *[[0, 0]] * 5])[2], [0, -1], atol=1e-6
    )
    assert np.all(np.isfinite(way_inside_turn(corners[:1])))


def test_staggered_clocks():
    state, rows = starts(*SPREAD)
    clock = np.asarray(state.step)
    assert clock.min() >= 0 and clock.max() < 1200
    assert np.abs(np.histogram(clock, 10, (0, 1200))[0] / COUNT - 0.1).max() < 0.02
    assert abs(np.corrcoef(clock, np.asarray(state.target))[0, 1]) < 0.08
    assert abs(np.corrcoef(clock, rows[:, 8])[0, 1]) < 0.08


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_each_group_of_constants_is_drawn_by_itself(kind):
    model = MODELS[kind]
    nominal = make_race(f"vehicle.model={kind}")[1].vehicle.constants
    numbers = np.random.default_rng(0).uniform(-1.0, 1.0, (COUNT, len(vars(nominal))))
    draw = jax.jit(jax.vmap(draw_constants, in_axes=(None, None, 0)), compiler_options=QUICK)
    for group, names in model.groups.items():
        spread = make_race(f"vehicle.model={kind}", f"randomization.{group}=0.2")[1].randomization
        found = draw(nominal, spread, numbers.astype(np.float32))
        for name, values in vars(found).items():
            value = float(getattr(nominal, name))
            if name in names and value != 0:
                spans(np.asarray(values)[:, None] / value, 0.8, 1.2)
            else:
                np.testing.assert_array_equal(values, np.float32(value))


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_randomization_of_the_config_reaches_the_episode(kind):
    """The drawn constants are the episode's own, drawn apart from its start."""
    overrides = (f"vehicle.model={kind}", "randomization.lag=0.3", "randomization.limits=0.1")
    state, rows = starts(*overrides)
    lags = {"motor": ("tau",), "rate": ("tau_rate", "tau_thrust")}[kind]
    nominal = make_race(*overrides)[1].vehicle.constants
    for name in lags:
        values = np.asarray(getattr(state.constants, name))
        spans(values[:, None] / float(getattr(nominal, name)), 0.7, 1.3)
        for column in range(13):
            assert abs(np.corrcoef(values, rows[:, column])[0, 1]) < 0.08
    np.testing.assert_array_equal(state.constants.g, np.float32(9.81))
    if kind == "motor":  # the propellers start within what this drone can do
        low = np.asarray(state.constants.rpm_min)[:, None]
        high = np.asarray(state.constants.rpm_max)[:, None]
        spans((rows[:, ref.RPM] - low) / (high - low), 0.0, 1.0)


def test_hover_start():
    for kind, actuators in (("motor", 7497.0), ("rate", 9.81)):
        state = hover_state(make_race(f"vehicle.model={kind}"))
        row = rows_of(state.drone)
        np.testing.assert_allclose(row[ref.P], ref.GATES[3])
        np.testing.assert_array_equal(row[[3, 4, 5, 6, 7, 9, 10, 11]], 0.0)
        assert row[8] == pytest.approx(0.0, abs=1e-6)  # the first gate is straight north
        np.testing.assert_allclose(row[12 : 16 if kind == "motor" else 13], actuators, rtol=1e-4)
        assert state.target == 0 and state.step == 0 and state.gates_passed == 0
    begin = hover_state(make_race("track.start={position: [0, 1, -2], yaw_deg: 200}")).drone
    np.testing.assert_allclose(begin.position.array(), [0, 1, -2])
    np.testing.assert_allclose(begin.euler.array(), [0, 0, np.radians(-160)], atol=1e-6)


def test_starts_repeat_with_their_key():
    (one, rows), (two, _), (_, other) = (drawn(*make_race(), seed=seed) for seed in (7, 7, 8))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    assert np.all(rows[:, 0] != other[:, 0])


def test_starts_along_the_way_to_the_next_gate():
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


def recorded(count: int = 5, **wrong) -> Flight:
    random = np.random.default_rng(3)
    arrays = {name: random.normal(size=(count, 3)) for name in MOTION}
    actuators = {"actuators": random.uniform(3000.0, 11000.0, (count, 4))}
    target = {"target": np.arange(count, dtype=float)[:, None] % 4}
    values = arrays | actuators | target | wrong
    signals = {name: Signal(array) for name, array in values.items()}
    return Flight("states", np.arange(float(count)), signals)


@pytest.mark.parametrize("part", [0.0, 0.4, 1.0])
def test_a_part_of_the_episodes_starts_in_recorded_states(tmp_path, part):
    own, path = recorded(), tmp_path / "states.npz"
    save([own], path)
    config = make_config(f"run.start_states={path}", f"run.start_states_part={part}")
    choices, params = choices_of(config), training_params(config)
    state, rows = drawn(choices, params)
    target = state.target
    distance = np.linalg.norm(rows[:, None, ref.V] - own["velocity"][None], axis=2)
    which = distance.argmin(axis=1)
    used = distance.min(axis=1) < 1e-5
    assert used.mean() == pytest.approx(part, abs=0.03)
    for name, columns in (("position", ref.P), ("attitude", ref.EULER), ("actuators", ref.RPM)):
        expected = own[name][which[used]]
        np.testing.assert_allclose(rows[used][:, columns], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(target[used], own.target[which[used]])
    np.testing.assert_array_equal(target[~used], 0)


def test_files_of_states_that_do_not_fit_are_one_line(tmp_path):
    path = tmp_path / "states.npz"
    for name, wrong, says in (
        ("target", np.full((5, 1), 4.0), "target is 4 to 4, allowed: the track's gates, 0 to 3"),
        ("actuators", np.ones((5, 1)), "has 1 actuators, the config's vehicle has 4"),
        ("rates", np.full((5, 3), np.nan), "rates"),
    ):
        save([recorded(**{name: wrong})], path)
        with pytest.raises(InputError, match=says):
            training_params(make_config(f"run.start_states={path}"))
    flight = recorded()
    save([flight.replace(signals={"position": flight.signals["position"]})], path)
    with pytest.raises(InputError, match="velocity is missing"):
        training_params(make_config(f"run.start_states={path}"))


def test_each_node_of_a_best_known_lap_has_the_gate_ahead_as_its_target(tmp_path):
    rng, lap = np.random.default_rng(0), tmp_path / "lap.npz"
    arrays = {name: rng.normal(size=(9, 3)) for name in ("position", "velocity", "rates")}
    arrays |= {"euler": np.full((9, 3), 4.0), "actuators": np.full((9, 4), 5000.0)}
    arrays |= {"time": np.arange(9.0), "leg_times": np.full(4, 2.0), "command": np.ones((9, 4))}
    gates = [gate.model_dump(mode="json") for gate in make_config().track.gates]
    write_npz(lap, arrays, {"format": LIMIT, "track": gates, "start": "periodic"})
    states = states_of("lap.npz", load(lap))
    assert states["target"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    np.testing.assert_array_equal(states["position"], arrays["position"][:-1])
    np.testing.assert_allclose(states["attitude"], 4.0 - 2.0 * np.pi)
    np.testing.assert_array_equal(states["actuators"], arrays["actuators"][:-1])


def test_starts_of_a_race():
    """A part of the episodes begins at rest around the start of timed laps."""
    ground = ("rules.ground_speed=5", "track.start={position: [1, -1.2, 0], yaw_deg: 20}")
    assert make_race()[1].start.race is None
    assert float(make_race(*ground)[1].start.race) == pytest.approx(0.1)
    overrides = ("start.race=0.25", "start.gate=random", "start.velocity=0.5")
    for own, place, yaw, lowest in (
        ((), ref.GATES[3], 0.0, 7497.0),
        (ground, [1.0, -1.2, 0.0], np.radians(20), 3000.0),
    ):
        state, rows = starts(*overrides, *own)
        rest = np.all(rows[:, ref.V] == 0.0, axis=1)
        assert 0.22 < rest.mean() < 0.28
        assert set(np.asarray(state.target)[rest]) == {0}
        assert set(np.asarray(state.target)[~rest]) == {0, 1, 2, 3}
        moved = rows[rest][:, ref.P] - place
        spans(moved[:, :2], -0.5, 0.5)
        np.testing.assert_allclose(moved[:, 2], 0.0, atol=1e-6)
        spans(rows[rest][:, 8] - yaw, -np.pi / 4, np.pi / 4)
        np.testing.assert_allclose(rows[rest][:, ref.RPM], lowest, rtol=1e-3)
