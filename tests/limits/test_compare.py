"""Where a flight loses time against another."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.limits.problem import ACTUATORS, ATTITUDE, POSITION, VELOCITY, make_problem

pytest.importorskip("casadi")


def _problem(*overrides):
    return make_problem(*race_of(load_config("indi +fastest", list(overrides))))


def test_a_slower_leg_is_where_the_time_is_lost():
    from quadjax.limits.compare import compare
    from quadjax.limits.guess import from_spline
    from quadjax.limits.trajectory import Trajectory

    best = from_spline(_problem(), 1, 10)
    slower = best.leg_times + np.array([0.0, 0.3, 0.0, 0.0])
    result = compare(best, Trajectory(slower, best.states, best.commands))
    assert result.gap == pytest.approx(0.3 / best.total)
    np.testing.assert_allclose(
        result.lost_per_meter, [0.0, 0.3 / result.length[1], 0.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(result.lost[[0, 50, 100, -1]], [0.0, 0.0, 0.3, 0.3], atol=1e-9)


def test_laps_are_cut_from_a_recorded_flight():
    from quadjax.limits.guess import from_flight, from_spline

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


def test_gates_at_one_place_have_one_label():
    from quadjax.limits.compare import flights_figure
    from quadjax.limits.trajectory import Trajectory

    config = load_config("indi +fastest", ["track=split_s"])
    problem = make_problem(*race_of(config))
    states = np.random.default_rng(0).normal(size=(29, 14))
    flights = {
        name: Trajectory(np.full(7, seconds), states, np.zeros((29, 4)))
        for name, seconds in (("best known", 0.5), ("policy", 0.6))
    }
    path, *others = flights_figure(problem, config.track.gates, flights).axes
    texts = [text.get_text() for text in path.texts]
    assert [text for text in texts if text and "m" not in text] == ["1", "2", "3", "4, 5", "6", "7"]
    assert [axes for axes in others if axes.get_ylabel() == "time lost [ms]"]
    (commands,) = [axes for axes in others if axes.get_ylabel() == "commands"]
    assert len(commands.get_yticklabels()) == 4
