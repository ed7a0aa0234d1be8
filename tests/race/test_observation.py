"""What the policy sees, against an independent version and under symmetries."""

import numpy as np
import pytest

from tests import reference as ref
from tests.race.support import compiled_observe, make_race, race_state, track_of

PAPER = (
    "disturbance.moment_x=0.03",
    "disturbance.moment_y=0.03",
    "disturbance.moment_z=0.01",
    "disturbance.force_z=0.5",
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
    choices, params = make_race(f"vehicle.model={kind}", wrapped, *disturbed(kind))
    centers, yaw = circuit(gates)
    params = params.replace(track=track_of(centers, yaw))
    rows = ref.random_states(kind, COUNT)
    target = np.arange(COUNT) % gates
    found = compiled_observe(choices)(params, race_state(kind, rows, target))
    assert found.shape == (COUNT, 24 if kind == "motor" else 17) and found.dtype == np.float32
    wanted = ref.observation(kind, CONSTANTS[kind], rows, target, centers, yaw, wrap_next_yaw=wrap)
    away = np.abs(np.abs(wanted[:, 8]) - np.pi) > 1e-3  # where the wrap may fall on either side
    np.testing.assert_allclose(found[away], wanted[away], atol=2e-5)
    assert away.mean() > 0.95


def test_by_hand():
    choices, params = make_race(*PAPER)
    rows = np.zeros((1, 22))
    rows[0, ref.P] = ref.GATES[0] + [1, 0, -0.5]
    rows[0, ref.V], rows[0, ref.EULER], rows[0, ref.RATES] = [0, 2, 3], [0.1, 0.2, 0.3], [4, 5, 6]
    rows[0, ref.RPM] = [3000, 5000, 7000, 11000]
    rows[0, ref.MOMENT], rows[0, 21] = [0.03, -0.015, 0.005], -0.25
    found = compiled_observe(choices)(params, race_state("motor", rows))[0]
    c = np.sqrt(0.5)
    expected = [c, -c, -0.5, 2 * c, 2 * c, 3, 0.1, 0.2, 0.3 - np.pi / 4, 4, 5, 6]
    expected += [-1, -0.5, 0, 1, 3 * c, 3 * c, 0, np.pi / 2, 1, -0.5, 0.5, -0.5]
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_unchanged_when_all_is_turned_and_moved(kind):
    choices, params = make_race(f"vehicle.model={kind}", *disturbed(kind))
    rows, target = ref.random_states(kind, COUNT), np.arange(COUNT) % 4
    turn, move = 2.2, np.array([3.0, -4.0, 0.7])
    matrix = ref.elementary(2, np.array(turn))
    turned = rows.copy()
    turned[:, ref.P] = rows[:, ref.P] @ matrix.T + move
    turned[:, ref.V] = rows[:, ref.V] @ matrix.T
    turned[:, 8] = ref.wrap(rows[:, 8] + turn)
    moved = track_of(ref.GATES @ matrix.T + move, ref.GATE_YAW + turn)
    observe = compiled_observe(choices)
    before = observe(params, race_state(kind, rows, target))
    after = observe(params.replace(track=moved), race_state(kind, turned, target))
    away = np.abs(np.abs(before[:, 8]) - np.pi) > 1e-3
    np.testing.assert_allclose(after[away], before[away], atol=3e-5)
    other = observe(params, race_state(kind, turned, target))
    assert np.abs(other[:, :2] - before[:, :2]).max() > 1


def test_disturbances_that_are_not_observed():
    rows = ref.random_states("motor", COUNT)
    state = race_state("motor", rows)
    for overrides in ((*PAPER, "observation.disturbance=none"), ()):
        choices, params = make_race(*overrides)
        found = compiled_observe(choices)(params, state)
        assert np.all(np.isfinite(found))
        np.testing.assert_array_equal(found[:, 20:], 0.0)
    choices, params = make_race(*PAPER)
    given = compiled_observe(choices)(params, state)
    np.testing.assert_array_equal(given[:, :20], found[:, :20])
    assert np.all(np.abs(given[:, 20:]).max(axis=0) > 0.9)


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_actuators_are_scaled_by_the_nominal_range(kind):
    """A policy does not know the range of the drone that was drawn."""
    choices, params = make_race(f"vehicle.model={kind}", "randomization.limits=0.2")
    rows = ref.random_states(kind, 3)
    state = race_state(kind, rows)
    own = params.vehicle.constants.replace(
        **{
            name: np.float32(0.8) * getattr(params.vehicle.constants, name)
            for name in (("rpm_max",) if kind == "motor" else ("thrust_max",))
        }
    )
    own = type(own)(**{name: np.broadcast_to(value, 3) for name, value in vars(own).items()})
    found = compiled_observe(choices)(params, state.replace(constants=own))
    wanted = ref.observation(kind, CONSTANTS[kind], rows, np.zeros(3, int), ref.GATES, ref.GATE_YAW)
    columns = slice(12, 16) if kind == "motor" else slice(12, 13)
    np.testing.assert_allclose(found[:, columns], wanted[:, columns], atol=1e-5)
