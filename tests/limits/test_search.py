"""Best known laps: found, verified, refused."""

import dataclasses
import threading

import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.limits.problem import ATTITUDE, VELOCITY, FlightOptions, make_problem
from tests.commands import run

pytest.importorskip("casadi")
from quadjax.limits import search as module  # noqa: E402
from quadjax.limits.guess import from_spline  # noqa: E402
from quadjax.limits.result import read_guess  # noqa: E402
from quadjax.limits.search import Search  # noqa: E402
from quadjax.limits.trajectory import Trajectory  # noqa: E402
from quadjax.limits.verify import verify  # noqa: E402


def _problem(*overrides, **options):
    return make_problem(
        *make_race(load_config("indi +fastest", list(overrides))), FlightOptions(**options)
    )


def _trajectory(seconds, intervals=2):
    states = np.tile(
        np.concatenate([np.zeros(6), np.eye(4)[0], np.zeros(4)]), (4 * intervals + 1, 1)
    )
    return Trajectory(np.full(4, seconds), states, np.zeros((4 * intervals + 1, 4)))


def test_the_speed_limit_of_a_race_is_a_constraint():
    assert _problem("rules.speed_limit=5").speed_limit == pytest.approx(5.0, rel=3e-3)
    assert _problem("rules.speed_limit=5", speed=4.0).speed_limit == 4.0


def test_a_search_that_finds_nothing_exits_with_1_and_keeps_the_last_solution(
    tmp_path, monkeypatch, capsys
):
    def interrupted(*arguments, **options):
        raise module.NotFoundError({"a": "stopped"}, _trajectory(1.0), "misses gate 1 by 3.0 mm")

    monkeypatch.setattr(module.Search, "run", interrupted)
    path = tmp_path / "lap.npz"
    assert run("limit", "indi +fastest", "--starts", "1", "--npz", path) == 1
    lines = capsys.readouterr().err
    assert "no flight was found" in lines and "a solution of 4.000 s" in lines
    assert "is not verified: misses gate 1 by 3.0 mm" in lines and "only for --guess" in lines
    flight = read_guess(_problem(), str(path))
    assert flight.total == 4.0
    np.testing.assert_allclose(flight.states, _trajectory(1.0).states, atol=1e-12)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["passages"][0, 2, 0] = arrays["passages"][0, 1, 0]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="leg 3 takes 0 s, allowed: above 0"):
        read_guess(_problem(), str(path))


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_flight_and_other_commands_are_refused(capfd):
    stop, texts = threading.Event(), []

    def report(text):
        texts.append(text)
        if search.best is not None:
            stop.set()

    problem = _problem()
    search = Search(problem, stop=stop, report=report)
    best = search.run(starts=2)
    assert texts[0] == "spline 1, 10 intervals a leg"  # before the first iteration
    assert best.total <= 2.65 and best.check.error == "" and best.check.clearance >= 0.0
    assert "User_Requested_Stop" in best.attempts["spline 1"]
    assert len(best.attempts) == 1 and "InternalOptiCallback" not in capfd.readouterr().err
    hasty = dataclasses.replace(best.trajectory, leg_times=0.97 * best.trajectory.leg_times)
    assert verify(problem, hasty).error
    limit = np.float64(best.check.top_speed - 0.01)
    rules = problem.params.rules.replace(speed_limit=limit)
    slow = dataclasses.replace(problem, params=problem.params.replace(rules=rules))
    assert "above the speed limit" in verify(slow, best.trajectory).error


@pytest.mark.slow
def test_a_race_from_rest_to_rest():
    problem = _problem(gates=6, stops=True)
    best = Search(problem, seconds=1000).run(starts=1)
    check = best.check
    assert len(check.leg_times) == 6
    np.testing.assert_allclose(check.velocity[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(check.velocity[-1], 0.0, atol=0.05)
    np.testing.assert_allclose(check.position[-1], problem.gates.position[1], atol=0.02)


@pytest.mark.slow
def test_a_lap_with_a_split_s_is_found_from_a_spline():
    race = make_race(load_config("e2e +fastest", ["vehicle=5inch", "track=split_s"]))
    stop = threading.Event()  # set at the first verified flight
    report = lambda text: search.best is not None and stop.set()  # noqa: E731
    search = Search(make_problem(*race, FlightOptions(speed=40.0)), 1000, stop, report)
    best = search.run(starts=1)
    assert best.total <= 3.25
    assert best.check.error == "" and best.check.clearance >= 0.0 and best.check.margin >= 0.0


def test_a_guess_closes_the_lap_and_its_thrust_is_along_the_force():
    problem = make_problem(*make_race(load_config("e2e +fastest", ["vehicle=5inch"])))
    guess = from_spline(problem, 1)
    quaternion = guess.states[:, ATTITUDE]
    assert abs(quaternion[0] @ quaternion[-1]) == pytest.approx(1.0, abs=1e-6)
    assert np.sum(quaternion[1:] * quaternion[:-1], axis=1).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0)
    acceleration = np.gradient(guess.states[:, VELOCITY], guess.times, axis=0)
    force, (w, x, y, z) = acceleration - [0.0, 0.0, 9.81], quaternion.T
    down = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    assert np.sum(force * -down, axis=1)[1:-1].min() > 0.95
