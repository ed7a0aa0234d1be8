"""Best known laps: found, verified, refused."""

import dataclasses
import json
import threading

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.errors import InputError
from quadjax.limits.problem import make_problem
from quadjax.limits.run import Race, problem_of
from tests.commands import run

pytest.importorskip("casadi")


def _problem(*overrides, **options):
    choices, params = race_of(load_config("indi", list(overrides)))
    return make_problem(choices.model, params, **options)


def test_a_gate_outside_the_bounds_is_named():
    with pytest.raises(InputError, match="gate 1: unreachable"):
        _problem(speed_limit=10.0, bounds=np.array([[-1.0, -1.0, -3.0], [1.0, 1.0, 0.0]]))


def test_a_clearance_that_leaves_no_opening_is_named():
    with pytest.raises(InputError, match=r"gate 1: a clearance of 0.5 m"):
        _problem(clearance=0.5)


def test_the_speed_limit_of_a_race_is_a_constraint():
    race = race_of(load_config("indi", ["rules.speed_limit=5"]))
    assert problem_of(*race, Race()).speed_limit == pytest.approx(5.0, rel=3e-3)
    assert problem_of(*race, Race(speed=4.0)).speed_limit == 4.0
    assert problem_of(*race, Race()).speed_rule == 5.0


def test_options_that_exclude_each_other(capsys):
    assert run("limit", "indi", "--laps", "3", "--gates", "3") == 2
    assert "--gates" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--speed=0", "--bound-speed=0", "--clearance=-1", "--policy="])
def test_numbers_that_have_no_meaning(option, capsys):
    assert run("limit", "e2e", option, "--seconds", "1") == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: ")


def _searched(stop_when):
    """A search on a small mesh that is stopped when ``stop_when(search)`` holds."""
    from quadjax.limits.guess import from_point_mass
    from quadjax.limits.solve import Search

    stop, problem = threading.Event(), _problem()
    guess = from_point_mass(problem, 8, 4.0)

    def report(text):
        if stop_when(search):
            stop.set()

    search = Search(problem, stop=stop, report=report)
    return search, [("a", guess), ("b", guess)]


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_flight():
    search, guesses = _searched(lambda search: search.best is not None)
    best = search.run(guesses)
    assert best.check.error == "" and best.check.clearance >= 0.0
    assert [each.guess for each in best.attempts] == ["a"]
    assert best.attempts[0].status == "User_Requested_Stop"


def test_of_several_guesses_the_fastest_after_the_first_stage_comes_first(monkeypatch):
    from quadjax.limits import solve as module
    from quadjax.limits.collocation import Solution
    from quadjax.limits.trajectory import Trajectory
    from quadjax.limits.verify import Check

    rows, zeros = np.zeros((1, 9)), np.zeros(3)
    check = Check("late", zeros, 0.0, 0.0, 0.0, 0.0, False, rows, rows, zeros)
    monkeypatch.setattr(module, "verify", lambda *_: check)
    monkeypatch.setattr(module, "solve", lambda p, d, guess, *_: Solution(guess, True, "", 0.0))
    times = {"point mass 1": 2.0, "point mass 2": 1.0, "point mass 3": 1.00001}
    guesses = [
        (name, Trajectory(np.full(4, seconds), np.zeros((17, 13)), np.zeros((17, 4))))
        for name, seconds in times.items()
    ]
    with pytest.raises(module.NotFoundError) as caught:
        module.Search(_problem()).run(guesses)
    tried = str(caught.value).split("(", 1)[1].split(")")[0].split("; ")
    assert [each[:12] for each in tried] == ["point mass 2", "point mass 3", "point mass 1"]
    assert "leads to that of point mass 2" in tried[1]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_small_violation_is_removed_before_the_mesh_is_refined(monkeypatch):
    from quadjax.limits import solve as module
    from quadjax.limits.collocation import Solution
    from quadjax.limits.trajectory import Trajectory
    from quadjax.limits.verify import Check

    rows, zeros, tried = np.zeros((1, 13)), np.zeros(3), []
    guess = Trajectory(np.ones(4), np.zeros((33, 13)), np.zeros((33, 4)))

    def solve(problem, dynamics, mesh, settings, effort):
        tried.append((mesh.intervals, settings.margin))
        return Solution(mesh, True, "", 0.0)

    def verify(problem, trajectory, tolerance=0.0):
        clearance = 0.001 if tried[-1:] > [(8, 0.003)] else -0.003
        return Check("", np.ones(4), clearance, 1.0, 5.0, 0.0, True, rows, rows, zeros)

    monkeypatch.setattr(module, "verify", verify)
    monkeypatch.setattr(module, "solve", solve)
    best = module.Search(_problem()).run([("guess", guess)])
    first, last = [(4, module.MARGIN), *2 * [(8, module.MARGIN)]], pytest.approx(0.0042)
    assert tried == [*first, (8, last), (16, last)]
    assert best.attempts[0].status == "verified" and best.margin == last


def test_ctrl_c_in_the_first_stage_writes_the_solution_that_is_not_verified(
    tmp_path, monkeypatch, capsys
):
    from quadjax.limits import run as module
    from quadjax.limits.best_known import NotFoundError, Unverified
    from quadjax.limits.report import read_guess
    from quadjax.limits.trajectory import Trajectory

    found = Trajectory(np.ones(4), np.zeros((9, 13)), np.zeros((9, 4)))

    def interrupted(*arguments, **options):
        raise NotFoundError("a: stopped", Unverified(found, "a", 0.02, "misses gate 1 by 3.0 mm"))

    monkeypatch.setattr(module, "search", interrupted)
    path = tmp_path / "lap.npz"
    assert run("limit", "indi", "--starts", "1", "--npz", path) == 1
    lines = capsys.readouterr().err
    assert "4.000 s with 2 intervals a leg and a reserve of 2% of the commands" in lines
    assert "is not verified: misses gate 1 by 3.0 mm" in lines and "only for --guess" in lines
    assert read_guess(_problem(), str(path)).total == 4.0


def test_a_search_that_finds_nothing_exits_with_1(monkeypatch, capsys):
    monkeypatch.setattr("quadjax.limits.solve.Search.over", True)
    assert run("limit", "indi", "--starts", "1") == 1
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    assert "no flight was found" in line


@pytest.mark.slow
def test_a_race_from_rest_to_rest():
    from quadjax.limits.guess import from_point_mass
    from quadjax.limits.simulation import positions, velocities
    from quadjax.limits.solve import Search

    problem = _problem(start="hover", stops=True, passages=6)
    best = Search(problem, seconds=1000).run([("a", from_point_mass(problem, 12, 4.0))])
    states = best.check.states
    assert len(best.check.leg_times) == 6
    np.testing.assert_allclose(velocities(problem, states[:1]), 0.0, atol=1e-9)
    np.testing.assert_allclose(velocities(problem, states[-1:]), 0.0, atol=0.05)
    np.testing.assert_allclose(
        positions(problem, states[-1:])[0], problem.gates.position[1], atol=0.02
    )


@pytest.mark.slow
def test_the_lap_on_square4_is_verified_and_other_commands_are_refused(monkeypatch):
    from quadjax.limits import verify as module
    from quadjax.limits.guess import from_point_mass
    from quadjax.limits.solve import Search
    from quadjax.limits.verify import verify

    problem = _problem()
    best = Search(problem, seconds=1000).run([("guess", from_point_mass(problem, 20, 4.0))])
    assert best.total <= 2.61
    assert best.check.error == "" and best.check.clearance >= 0.0
    claimed = best.trajectory
    hasty = dataclasses.replace(claimed, leg_times=0.97 * claimed.leg_times)
    assert verify(problem, hasty).error
    flown = best.check.states, best.check.commands
    monkeypatch.setattr(module, "follow", lambda *_: flown)  # a regulator flies no slower
    slow = dataclasses.replace(problem, speed_rule=best.check.top_speed - 0.01)
    assert verify(slow, claimed).error == "exceeds the speed limit"


@pytest.mark.slow
def test_a_lap_with_a_split_s_is_found_from_the_flight_of_a_point_mass():
    from quadjax.limits.guess import from_point_mass
    from quadjax.limits.solve import Search

    choices, params = race_of(load_config("e2e_fastest", ["vehicle=5inch", "track=split_s"]))
    problem = make_problem(choices.model, params, speed_limit=40.0)
    stop = threading.Event()  # set at the first verified flight
    search = Search(problem, 1000, stop, lambda text: search.best is not None and stop.set())
    best = search.run([("point mass", from_point_mass(problem, 12, 4.0))])
    assert best.total <= 3.25
    assert best.check.error == "" and best.check.clearance >= 0.0 and best.check.margin >= 0.0


def test_the_nose_of_a_guess_for_a_quaternion_closes_the_lap():
    from quadjax.limits.guess import from_path

    choices, params = race_of(load_config("e2e_fastest", ["vehicle=5inch"]))
    problem = make_problem(choices.model, params)
    angle = np.linspace(0.0, 2.0 * np.pi, 17)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], axis=1)
    force = 20.0 * circle - [0.0, 0.0, 9.81]
    rest = np.zeros((17, 3))
    guess = from_path(problem, np.ones(4), circle, rest, force, np.zeros(17), True)
    quaternion = guess.states[:, problem.normalized]
    assert abs(quaternion[0] @ quaternion[-1]) == pytest.approx(1.0, abs=1e-6)
    assert np.sum(quaternion[1:] * quaternion[:-1], axis=1).min() > 0.9


@pytest.mark.slow
def test_the_command_writes_a_bracket(tmp_path, capsys):
    path, table = tmp_path / "limit.json", tmp_path / "limit.npz"
    assert run("limit", "indi", "--starts", 1, "--json", path, "--npz", table) == 0
    report = json.loads(path.read_text())
    assert 0.8 * report["best_known"] < report["lower_bound"] < report["best_known"]
    with np.load(table) as arrays:
        assert arrays["time"][-1] == pytest.approx(report["best_known"], rel=5e-3)
    assert "best known" in capsys.readouterr().out


def test_a_finer_mesh_starts_from_the_middle_states_of_the_collocation():
    from quadjax.limits.collocation import Dynamics
    from quadjax.limits.tracking import refined
    from quadjax.limits.trajectory import Trajectory

    problem, rng = _problem(), np.random.default_rng(0)
    states = 0.3 * rng.normal(size=(9, 13))
    states[:, problem.actuator_leaves] = 9.0
    low, high = problem.command_range
    commands = rng.uniform(low, high, (9, len(low)))
    coarse = Trajectory(np.array([0.4, 0.6, 0.5, 0.3]), states, commands)
    fine, dynamics = refined(problem, coarse, 4), Dynamics(problem)
    np.testing.assert_allclose(fine.states[::2], states, atol=1e-12)
    pairs = zip(states, commands, strict=True)
    slope = np.array([np.array(dynamics.slope(x, u)).ravel() for x, u in pairs])
    step = np.repeat(coarse.leg_times / 2, 2)[:, None]
    middle = 0.5 * (states[1:] + states[:-1]) + step / 8.0 * (slope[:-1] - slope[1:])
    np.testing.assert_allclose(fine.states[1::2], middle, atol=1e-9)
