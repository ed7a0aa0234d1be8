"""Gates of the solver are those of the race; laps of flights."""

import threading

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.race.openings import inside_opening
from quadjax.race.track import TrackSection, gate, make_track, to_opening_frame

pytest.importorskip("casadi")
from quadjax.limits.collocation import Dynamics, Settings, solve  # noqa: E402
from quadjax.limits.guess import from_flight, from_spline  # noqa: E402
from quadjax.limits.problem import (  # noqa: E402
    ACTUATORS,
    ATTITUDE,
    POSITION,
    VELOCITY,
    FlightOptions,
    make_gates,
    make_problem,
)
from quadjax.limits.verify import passages  # noqa: E402


def _problem(*overrides):
    return make_problem(*make_race(load_config("indi +fastest", list(overrides))))


def _track():
    rows = (
        ([0.0, 0.0, -2.0], 17.0, [1.0, 0.6], 28.0, -17.0, "rectangle"),
        ([2.0, 1.0, -1.5], 115.0, [0.8, 0.8], 0.0, 23.0, "circle"),
        ([1.0, -1.0, -1.0], -57.0, [1.2, 1.0], 0.0, 0.0, "rectangle"),
    )
    names = ("position", "yaw_deg", "size", "roll_deg", "pitch_deg", "shape")
    return make_track(TrackSection(gates=[dict(zip(names, row, strict=True)) for row in rows]))


def test_a_place_has_clearance_where_the_rules_let_it_pass():
    track, rng = _track(), np.random.default_rng(0)
    gates = make_gates(track)
    for index in range(3):
        g = gate(track, index)
        across = rng.uniform(-1.2, 1.2, (300, 2))
        places = gates.position[index] + across @ gates.axes[index, 1:]
        with jax.enable_x64(True):
            local = to_opening_frame(g, Vec3.of(places) - g.position)
            inside = inside_opening(local, g, 0.0)
        np.testing.assert_allclose(local.x, 0.0, atol=1e-6)
        found = np.array([gates.clearance(index, place) for place in places])
        np.testing.assert_array_equal(found > 0.0, np.asarray(inside))
        assert 0.02 < np.mean(found > 0.0) < 0.9


GATES = (
    "track={name: two, start: {position: [0, 0, -1], yaw_deg: 0}, gates: ["
    "{position: [3, 1.5, -2.5], yaw_deg: 0, size: [1, 1]%s}, "
    "{position: [6, 0, -1], yaw_deg: 0, size: [1, 1]}]}"
)
MARGIN = 0.01  # m


@pytest.mark.parametrize("shape", ["", ", shape: circle", ", roll_deg: 45"])
def test_a_gate_beside_the_way_is_passed_at_its_edge(shape):
    race = make_race(load_config("indi", [GATES % shape]))
    problem = make_problem(*race, FlightOptions(gates=2, stops=True))
    guess, settings = from_spline(problem, 1, 8), Settings(MARGIN, smoothness=1e-3)
    arguments = Dynamics(problem), guess, settings, threading.Event(), lambda _: None
    flight = solve(problem, *arguments).trajectory
    place = flight.states[8, POSITION]
    assert problem.gates.clearance(0, place) == pytest.approx(MARGIN, abs=1e-3)


def test_a_body_radius_narrows_openings_bounds_and_ground():
    rules = ["rules.body_radius=0.1", "rules.gate_frame=0.2", "rules.bounds=[[-9,9],[-9,9],[-5,0]]"]
    environment, params = make_race(load_config("indi +fastest", rules))
    problem = make_problem(environment, params)
    point = make_gates(params.track)
    np.testing.assert_allclose(problem.gates.half_size, point.half_size - 0.1, atol=1e-6)
    np.testing.assert_allclose(problem.bounds, [[-8.9, -8.9, -4.9], [8.9, 8.9, -0.1]], atol=1e-6)
    assert problem.frame_depth == pytest.approx(0.15)
    with pytest.raises(InputError, match="gate 1: no wider than the drone"):
        make_gates(params.track, radius=2.0)


@pytest.mark.parametrize(("clearance", "right", "leeway"), [
    (0.0, 0.3, 0.2), (0.2, 0.25, 0.05), (0.2, 0.35, -0.05), (None, 0.01, 0.01), (None, 0.3, -0.28),
])  # fmt: skip
def test_a_passage_is_measured_against_the_required_clearance(clearance, right, leeway):
    race = make_race(load_config("e2e +fastest"))
    problem = make_problem(*race, FlightOptions(clearance=clearance))
    ahead, side, _ = problem.gates.axes[0]
    way = np.linspace(-0.5, 0.5, 12)[:, None] * ahead + right * side
    path = problem.gates.position[0] + way
    times, (place,) = passages(problem.gates, [0], path, 1e-3, 0.0)
    np.testing.assert_allclose(times, [5.5e-3])
    assert problem.leeway(0, place) == pytest.approx(leeway, abs=1e-6)
    assert not len(passages(problem.gates, [0], path + side, 1e-3, 0.3)[0])


def test_laps_are_cut_from_a_recorded_flight():
    problem = _problem()
    states = from_spline(problem, 1, 50).states[:-1]
    parts = states[:, POSITION], states[:, VELOCITY], *np.zeros((2, 200, 3))
    motion = [np.tile(x, (3, 1)) for x in parts]
    motion[2][:, 2] = np.linspace(0.0, 9.0, 600) % (2.0 * np.pi)
    columns = [*motion, np.full((600, 1), 9.0), np.zeros((600, 4))]
    (lap, *_) = from_flight(problem, columns, 0.01, 10)
    assert lap.leg_times == pytest.approx(0.5 * np.ones(4), abs=0.011)
    gates = lap.states[::10, POSITION]
    np.testing.assert_allclose(gates, problem.gates.position[[3, 0, 1, 2, 3]], atol=0.05)
    assert np.linalg.norm(lap.states[:, VELOCITY], axis=1).min() > 1.0
    np.testing.assert_allclose(lap.states[:, ACTUATORS], 9.0)
    assert np.abs(np.diff(lap.states[:, ATTITUDE], axis=0)).max() < 0.3
