"""Where a flight loses time against another."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.limits.problem import make_problem

pytest.importorskip("casadi")


def test_a_slower_leg_is_where_the_time_is_lost():
    from quadjax.limits.compare import compare
    from quadjax.limits.guess import from_path
    from quadjax.limits.point_mass import spline
    from quadjax.limits.trajectory import Trajectory

    choices, params = race_of(load_config("indi"))
    problem = make_problem(choices.model, params)
    times, place, velocity, _ = spline(problem, 10, 4.0, 0.0, np.random.default_rng(0))
    up = np.tile([0.0, 0.0, -9.81], (len(place), 1))
    best = from_path(problem, times, place, velocity, up, np.zeros(len(place)))
    slower = best.leg_times + np.array([0.0, 0.3, 0.0, 0.0])
    result = compare(problem, best, Trajectory(slower, best.states, best.commands))
    assert result.gap == pytest.approx(0.3 / best.total)
    np.testing.assert_allclose(
        result.lost_per_meter, [0.0, 0.3 / result.length[1], 0.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(result.lost[[0, 50, 100, -1]], [0.0, 0.0, 0.3, 0.3], atol=1e-9)
