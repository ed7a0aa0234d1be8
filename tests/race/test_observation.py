"""What the policy sees, and penalties of it, against float64 versions and under symmetries."""

import types

import jax
import numpy as np
import pytest

from quadjax.core.vectors import Rotors
from quadjax.race.layout import LAST_ACTION
from quadjax.race.track import gates_ahead
from quadjax.race.types import Step
from tests import reference as ref
from tests.race.support import (
    ROWS,
    compiled_observe,
    compiled_reset,
    compiled_transition,
    level,
    make_race,
    race_state,
    track_of,
)

PAPER = tuple(
    f"disturbance.{key}"
    for key in ("moment_x=0.03", "moment_y=0.03", "moment_z=0.01", "force_z=0.5")
)
COUNT = 500
CONSTANTS = {"motor": ref.MOTOR, "rate": ref.RATE}


def disturbed(kind):
    """The paper's disturbances, which the rate-level vehicle does not have."""
    return PAPER if kind == "motor" else ()


def circuit(gates):
    """Gates anywhere, turned anyhow."""
    draw = np.random.default_rng(gates)
    return draw.uniform(-5, 5, (gates, 3)), draw.uniform(-4, 8, gates)


@pytest.mark.parametrize(
    ("kind", "gates", "wrap"),
    [("motor", 1, True), ("motor", 6, True), ("motor", 4, False), ("rate", 6, True)],
)
def test_against_an_independent_version(kind, gates, wrap):
    wrapped = f"observation.wrap_next_yaw={str(wrap).lower()}"
    environment, params = make_race(f"vehicle.model={kind}", wrapped, *disturbed(kind))
    centers, yaw = circuit(gates)
    params = params.replace(track=track_of(centers, yaw))
    rows = ref.random_states(kind, COUNT)
    target = np.arange(COUNT) % gates
    found = compiled_observe(environment)(params, race_state(kind, rows, target))
    assert found.shape == (COUNT, 24 if kind == "motor" else 17) and found.dtype == np.float32
    wanted = ref.observation(kind, CONSTANTS[kind], rows, target, centers, yaw, wrap_next_yaw=wrap)
    away = np.abs(np.abs(wanted[:, 8]) - np.pi) > 1e-3  # where the wrap may fall on either side
    np.testing.assert_allclose(found[away], wanted[away], atol=2e-5)
    assert away.mean() > 0.95


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_unchanged_when_all_is_turned_and_moved(kind):
    environment, params = make_race(f"vehicle.model={kind}", *disturbed(kind))
    rows, target = ref.random_states(kind, COUNT), np.arange(COUNT) % 4
    turn, move = 2.2, np.array([3.0, -4.0, 0.7])
    matrix = ref.elementary(2, np.array(turn))
    turned = rows.copy()
    turned[:, ref.P] = rows[:, ref.P] @ matrix.T + move
    turned[:, ref.V] = rows[:, ref.V] @ matrix.T
    turned[:, 8] = ref.wrap(rows[:, 8] + turn)
    moved = track_of(ref.GATES @ matrix.T + move, ref.GATE_YAW + turn)
    observe = compiled_observe(environment)
    before = observe(params, race_state(kind, rows, target))
    after = observe(params.replace(track=moved), race_state(kind, turned, target))
    away = np.abs(np.abs(before[:, 8]) - np.pi) > 1e-3
    np.testing.assert_allclose(after[away], before[away], atol=3e-5)


def test_disturbances_that_are_not_observed():
    state, found = race_state("motor", ref.random_states("motor", COUNT)), []
    for overrides in (PAPER, (*PAPER, "observation.disturbance=none"), ()):
        environment, params = make_race(*overrides)
        found.append(compiled_observe(environment)(params, state))
        np.testing.assert_array_equal(found[-1][:, :20], found[0][:, :20])
    assert np.all(np.abs(found[0][:, 20:]).max(axis=0) > 0.9)
    assert not found[1][:, 20:].any() and not found[2][:, 20:].any()


@pytest.mark.parametrize(("kind", "key"), [("motor", "rpm_max"), ("rate", "thrust_max")])
def test_actuators_are_scaled_by_the_nominal_range(kind, key):
    """A policy does not know the range of the drone that was drawn."""
    environment, params = make_race(f"vehicle.model={kind}", "randomization.limits=0.2")
    rows, nominal = ref.random_states(kind, 3), params.vehicle.constants
    drawn = nominal.replace(**{key: np.float32(0.8) * getattr(nominal, key)})
    drawn = jax.tree.map(lambda x: np.broadcast_to(x, 3), drawn)
    found = compiled_observe(environment)(params, race_state(kind, rows).replace(constants=drawn))
    wanted = ref.observation(kind, CONSTANTS[kind], rows, np.zeros(3, int), ref.GATES, ref.GATE_YAW)
    columns = slice(12, 16 if kind == "motor" else 13)
    np.testing.assert_allclose(found[:, columns], wanted[:, columns], atol=1e-5)


def ahead_of(index, count, centers, yaw):
    """The pose of a later gate in a gate's frame, float64."""
    other = (index + count) % len(centers)
    turn = ref.elementary(2, np.array(yaw[index]))
    return turn.T @ (centers[other] - centers[index]), ref.wrap(yaw[other] - yaw[index])


@pytest.mark.parametrize("gates", [1, 5])
def test_gates_after_the_next_one_are_observed(gates):
    centers, yaw = circuit(gates)
    environment, params = make_race("observation.gates_ahead=3")
    params = params.replace(track=track_of(centers, yaw))
    state = race_state("motor", level(np.zeros((gates, 3)), np.zeros(3)), np.arange(gates))
    found = compiled_observe(environment)(params, state)
    for index, count in np.ndindex(gates, 2):
        place, turn = ahead_of(index, count + 2, centers, yaw)
        name = f"next{count + 2}"
        position = found[index, environment.layout.slice(f"{name}_position")]
        np.testing.assert_allclose(position, place, atol=2e-5)
        (angle,) = found[index, environment.layout.slice(f"{name}_yaw")]
        assert abs(ref.wrap(angle - turn)) < 1e-5


def test_gates_after_the_end_of_a_course_are_straight_ahead():
    track = track_of(ref.GATES, ref.GATE_YAW, closed=False)
    place, yaw = jax.jit(gates_ahead, static_argnums=1)(track, 2)
    position = np.stack([*place], axis=-1)
    np.testing.assert_allclose(position[-1], [10, 0, 0], atol=1e-5)
    last, turn = ahead_of(2, 1, ref.GATES, ref.GATE_YAW)
    beyond = last + 5.0 * np.array([np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(position[2], beyond, atol=1e-5)
    assert abs(float(yaw[2]) - turn) < 1e-6 and float(yaw[3]) == 0


def test_actuators_are_scaled_by_a_range_of_the_config():
    environment, params = make_race(
        "vehicle=5inch", "track=figure8_tudelft", "observation.actuator_range=[0, 3000]"
    )
    assert environment.layout.size == 20  # the published observation of racing quadcopters
    field = environment.layout.with_spans(environment.model, params)["rotor_speed"]
    assert field.span == ((0.0, 3000.0),) * 4
    drone = types.SimpleNamespace(actuators=Rotors(*np.float32([0.0, 1500, 3000, 600])))
    found = field.numbers(Step(environment.model, params, types.SimpleNamespace(drone=drone), None))
    np.testing.assert_allclose(found, [-1, 0, 1, -0.6], atol=1e-6)


def test_the_last_action_and_the_penalty_of_its_change():
    more = ("reward.action_change=0.25", "observation.last_action=true")
    (environment, params), plain = make_race(*more), make_race()
    state = race_state("motor", ref.random_states("motor", ROWS), np.arange(ROWS) % 4)
    action = np.random.default_rng(0).uniform(-1.5, 1.5, (ROWS, 4)).astype(np.float32)
    begun = state.replace(memories={LAST_ACTION: (np.full(ROWS, 0.5, np.float32),) * 4})
    following, value, _ = compiled_transition(environment)(params, begun, action)
    _, without, _ = compiled_transition(plain[0])(plain[1], state, action)
    change = 0.25 * np.abs(np.clip(action, -1, 1) - 0.5).sum(axis=1)
    np.testing.assert_allclose(without - value, change, atol=1e-4)
    columns = environment.layout.slice("last_action")  # 0 at a start
    for each, wanted in (
        (following, np.clip(action, -1, 1)),
        (compiled_reset(environment)(params, jax.random.key(0), 2), np.zeros((2, 4))),
    ):
        found = compiled_observe(environment)(params, each)[:, columns]
        np.testing.assert_allclose(found, wanted, atol=1e-6)
