"""Best known laps: found, verified, refused."""

import dataclasses
import json
import threading

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.errors import InputError
from quadjax.core.traced import with_leaves
from quadjax.limits.problem import ATTITUDE, VELOCITY, Flight, make_problem
from tests.commands import run

pytest.importorskip("casadi")


def _problem(*overrides, **options):
    return make_problem(*race_of(load_config("indi +fastest", list(overrides))), Flight(**options))


def _trajectory(seconds, intervals=2):
    from quadjax.limits.trajectory import Trajectory

    states = np.tile(
        np.concatenate([np.zeros(6), np.eye(4)[0], np.zeros(4)]), (4 * intervals + 1, 1)
    )
    return Trajectory(np.full(4, seconds), states, np.zeros((4 * intervals + 1, 4)))


def test_a_clearance_that_leaves_no_opening_is_named():
    with pytest.raises(InputError, match=r"gate 1: a clearance of 0.5 m"):
        _problem(clearance=0.5)


def test_rules_that_are_not_supported_are_named():
    with pytest.raises(InputError, match="world_box"):
        _problem("rules.gate_test=world_box")


def test_the_speed_limit_of_a_race_is_a_constraint():
    assert _problem("rules.speed_limit=5").speed_limit == pytest.approx(5.0, rel=3e-3)
    assert _problem("rules.speed_limit=5", speed=4.0).speed_limit == 4.0


def test_options_that_exclude_each_other(capsys):
    assert run("limit", "indi +fastest", "--laps", "3", "--gates", "3") == 2
    assert "--gates" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--speed=0", "--bound-speed=0", "--clearance=-1", "--policy="])
def test_numbers_that_have_no_meaning(option, capsys):
    assert run("limit", "e2e", option, "--seconds", "1") == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: ")


def _stub(monkeypatch, clearance):
    """A search whose solutions are its guesses, verified where ``clearance(margin)`` allows."""
    from quadjax.limits import search as module
    from quadjax.limits.verify import Check

    tried, rows = [], np.zeros((2, 3))

    def solve(problem, dynamics, mesh, settings, *others):
        tried.append((mesh.intervals, settings.margin))
        return module.Solution(mesh, True, "")

    def verify(problem, trajectory):
        inside = clearance(tried[-1][1] if tried else 0.0)
        error = "" if inside >= 0.0 else "late"
        return Check(
            error, np.full(4, trajectory.total / 4), inside, 1.0, 0.0, True, rows, rows, rows
        )

    monkeypatch.setattr(module, "verify", verify)
    monkeypatch.setattr(module, "solve", solve)
    return module, tried


def test_a_guess_that_leads_to_a_slower_flight_is_not_refined(monkeypatch):
    module, _ = _stub(monkeypatch, lambda margin: 0.0)
    guesses = {name: _trajectory(s, 16) for name, s in (("a", 2.0), ("b", 1.0), ("c", 1.5))}
    best = module.Search(_problem()).run(guesses, starts=0)
    assert best.total == 4.0 and best.guess == "b"
    assert "verified" in best.attempts["b"] and "not faster" in best.attempts["c"]


def test_a_small_miss_is_removed_before_the_mesh_is_refined(monkeypatch):
    module, tried = _stub(monkeypatch, lambda margin: 0.001 if margin > 0.003 else -0.003)
    best = module.Search(_problem()).run({"guess": _trajectory(1.0, 8)}, starts=0)
    first, wider = [(4, module.MARGIN), *2 * [(8, module.MARGIN)]], pytest.approx(0.0042)
    assert tried == [*first, (8, wider), (16, wider)]
    assert "verified" in best.attempts["guess"]


def test_a_search_that_finds_nothing_exits_with_1_and_keeps_the_last_solution(
    tmp_path, monkeypatch, capsys
):
    from quadjax.limits import search as module
    from quadjax.limits.result import read_guess

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


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_flight(capfd):
    from quadjax.limits.search import Search

    stop = threading.Event()

    def report(text):
        if search.best is not None:
            stop.set()

    search = Search(_problem(), stop=stop, report=report)
    best = search.run(starts=2)
    assert best.check.error == "" and best.check.clearance >= 0.0
    assert "User_Requested_Stop" in best.attempts["spline 1"]
    assert len(best.attempts) == 1 and "InternalOptiCallback" not in capfd.readouterr().err


@pytest.mark.slow
def test_a_race_from_rest_to_rest():
    from quadjax.limits.search import Search

    problem = _problem(gates=6, stops=True)
    best = Search(problem, seconds=1000).run(starts=1)
    check = best.check
    assert len(check.leg_times) == 6
    np.testing.assert_allclose(check.velocity[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(check.velocity[-1], 0.0, atol=0.05)
    np.testing.assert_allclose(check.position[-1], problem.gates.position[1], atol=0.02)


@pytest.mark.slow
def test_the_lap_on_square4_is_verified_and_other_commands_are_refused():
    from quadjax.limits.search import Search
    from quadjax.limits.verify import verify

    problem = _problem()
    best = Search(problem, seconds=1000).run(starts=1)
    assert best.total <= 2.61
    assert best.check.error == "" and best.check.clearance >= 0.0
    hasty = dataclasses.replace(best.trajectory, leg_times=0.97 * best.trajectory.leg_times)
    assert verify(problem, hasty).error
    limit = np.float64(best.check.top_speed - 0.01)
    rules = with_leaves(problem.params.rules, speed_limit=limit)
    slow = dataclasses.replace(problem, params=problem.params.replace(rules=rules))
    assert "above the speed limit" in verify(slow, best.trajectory).error


@pytest.mark.slow
def test_a_lap_with_a_split_s_is_found_from_a_spline():
    from quadjax.limits.search import Search

    race = race_of(load_config("e2e +fastest", ["vehicle=5inch", "track=split_s"]))
    stop = threading.Event()  # set at the first verified flight
    report = lambda text: search.best is not None and stop.set()  # noqa: E731
    search = Search(make_problem(*race, Flight(speed=40.0)), 1000, stop, report)
    best = search.run(starts=1)
    assert best.total <= 3.25
    assert best.check.error == "" and best.check.clearance >= 0.0 and best.check.margin >= 0.0


@pytest.mark.parametrize("index", [0, 1, 2])
def test_a_guess_closes_the_lap_and_its_thrust_is_along_the_force(index):
    from quadjax.limits.guess import from_spline

    problem = make_problem(*race_of(load_config("e2e +fastest", ["vehicle=5inch"])))
    guess = from_spline(problem, index)
    quaternion = guess.states[:, ATTITUDE]
    assert abs(quaternion[0] @ quaternion[-1]) == pytest.approx(1.0, abs=1e-6)
    assert np.sum(quaternion[1:] * quaternion[:-1], axis=1).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0)
    acceleration = np.gradient(guess.states[:, VELOCITY], guess.times, axis=0)
    force, (w, x, y, z) = acceleration - [0.0, 0.0, 9.81], quaternion.T
    down = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    assert np.sum(force * -down, axis=1)[1:-1].min() > 0.95


@pytest.mark.slow
def test_the_command_writes_a_bracket(tmp_path, capsys):
    path, table = tmp_path / "limit.json", tmp_path / "limit.npz"
    assert run("limit", "indi +fastest", "--starts", 1, "--json", path, "--npz", table) == 0
    report = json.loads(path.read_text())
    assert 0.8 * report["best_known"] < report["lower_bound"] < report["best_known"]
    with np.load(table) as arrays:
        assert arrays["time"][0, -1] == pytest.approx(report["best_known"], rel=5e-3)
    assert "best known" in capsys.readouterr().out


def test_a_finer_mesh_starts_from_the_middle_states_of_the_collocation():
    from quadjax.limits.collocation import Dynamics
    from quadjax.limits.trajectory import Trajectory

    problem, rng = _problem(), np.random.default_rng(0)
    states = problem.start + 0.3 * rng.normal(size=(9, len(problem.start)))
    low, high = problem.command_range
    commands = rng.uniform(low, high, (9, len(low)))
    coarse = Trajectory(np.array([0.4, 0.6, 0.5, 0.3]), states, commands)
    fine, dynamics = coarse.resample(4, problem), Dynamics(problem)
    np.testing.assert_allclose(fine.states[::2], states, atol=1e-12)
    pairs = zip(states, commands, strict=True)
    slope = np.array([np.array(dynamics.slope(x, u)).ravel() for x, u in pairs])
    step = np.repeat(coarse.leg_times / 2, 2)[:, None]
    middle = 0.5 * (states[1:] + states[:-1]) + step / 8.0 * (slope[:-1] - slope[1:])
    np.testing.assert_allclose(fine.states[1::2], middle, atol=1e-9)
