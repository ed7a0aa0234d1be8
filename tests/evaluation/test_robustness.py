"""The protocol of flights with randomized constants."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.cli import run
from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.resources import PRETRAINED
from quadjax.policy import pilot
from quadjax.race.laps import begin, fly_race, starting_states
from quadjax.studies import robustness
from quadjax.studies.race_flights import RaceFlights, fly_with_speeds, race_table
from quadjax.studies.robustness import Flights, fly_spreads, spread_table, start_before_gate
from tests import reference as ref
from tests.evaluation.support import random_policy, rate_race, script, scripted
from tests.race.support import BLANK


def test_flights_start_before_the_gates():
    choices, params = race_of(load_config(BLANK, ["randomization.all=0.2"]))
    keys = jax.random.split(jax.random.key(0), 400)
    one = jax.vmap(lambda key: start_before_gate(choices, params, key))
    state = jax.tree.map(np.asarray, jax.jit(one)(keys))
    drone = state.drone
    place = np.stack([drone.position.x, drone.position.y, drone.position.z], 1)
    yaw = np.asarray(ref.GATE_YAW)[state.target]
    behind = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
    np.testing.assert_allclose(place, ref.GATES[state.target] - behind, atol=1e-5)
    assert set(state.target) == {0, 1, 2, 3}
    for values, half in (
        (drone.velocity.x, 0.5),
        (drone.euler.x, math.pi / 9),
        (drone.euler.z, math.pi),
        (drone.rates.y, 0.1),
        (state.constants.k_w / ref.MOTOR["k_w"] - 1, 0.2),
    ):
        assert 0.95 * half < np.abs(values).max() <= half * (1 + 1e-5)


def test_the_table_has_a_column_for_each_randomization():
    flights = [Flights("±0%", 200, 5, 0, 1.51), Flights("±10%", 200, 200, 0, math.nan)]
    lines = spread_table(flights, "mine").splitlines()
    assert (
        lines[0] == "| policy | ±0% | ±10% |" and lines[2] == "| mine | 2.5% / 1.510 s | 100% / - |"
    )
    assert flights[1].to_json()["lap"] is None


def test_a_drone_that_hovers_is_neither_crashed_nor_has_it_a_lap(monkeypatch):
    """A pilot that holds still in place of the policy: no crash, and no lap either."""
    config, _, _ = rate_race()
    monkeypatch.setattr(pilot, "fly", lambda own, observation, noise: hover)
    hover = jnp.array([0.0, 0.0, 0.0, 2.0 * 9.81 / 15.0 - 1.0])
    monkeypatch.setattr(robustness, "ROLL_PITCH", 0.0)
    monkeypatch.setattr(robustness, "VELOCITY", 0.0)
    monkeypatch.setattr(robustness, "RATES", 0.0)
    (still,) = fly_spreads(random_policy("rate"), config, 4, 0.5, spreads=(0.0,))
    assert (still.crashed, still.without_lap, still.runs) == (0, 4, 4)
    assert "| 0% and 100% without a lap / - |" in spread_table([still], "still")
    assert still.to_json()["without_lap"] == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--study", "spread", "--laps", "3"], "--laps has no effect with --study spread"),
        (["--study", "spread", "--figure", "x.png"], "--figure has no effect with --study spread"),
        (["--seconds", "3"], "--seconds has no effect with --study laps"),
        (["--study", "nap"], '"spread", "races"'),
        (["--study", "spread", "--gates", "3"], "--gates has no effect with --study spread"),
        (
            ["--study", "races", "--seconds", "3"],
            "--seconds has no effect with --study races",
        ),
    ],
)
def test_options_without_effect_are_refused(options, message, capsys):
    assert run(["evaluate", "e2e", "--policy", "none.npz", *options]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_more_drones_crash_with_larger_errors(tmp_path, capsys):
    file, policy = tmp_path / "found.json", PRETRAINED / "e2e_fastest.npz"
    options = ["--study", "spread", "--runs", "60", "--seconds", "7", "--json", str(file)]
    command = ["evaluate", "e2e +fastest", "--policy", str(policy), *options]
    assert run(command) == 0
    assert "| e2e_fastest | " in capsys.readouterr().out
    found = json.loads(file.read_text())["flights"]
    assert [each["label"] for each in found] == ["±0%", "±10%", "±20%", "±30%"]
    assert found[0]["crashed"] < found[-1]["crashed"] <= 60
    assert 1.9 < found[0]["lap"] < 2.3


def test_the_speeds_of_a_race_are_those_of_its_flight():
    _, choices, params = rate_race()
    states = starting_states(choices, params, jax.random.key(0), 2, True, around=True)
    key = jax.random.key(1)
    _, trace = fly_race(choices, scripted, 1, 250, True, params, script(), states, key)
    drones = begin(states, 1), key
    _, found = fly_with_speeds(choices, scripted, 250, None, params, script(), drones, 2.0)
    to_first, highest, above = found
    speed = np.linalg.norm(trace.velocity, axis=1)[1:]  # after each step but the last
    np.testing.assert_allclose(highest, speed.max(axis=0), rtol=1e-3)
    seconds = 0.01 * (speed > 2.0).sum(axis=0)
    np.testing.assert_allclose(above, seconds, atol=0.011)
    first = 0.01 * (trace.target == 0).sum(axis=0)
    np.testing.assert_allclose(to_first, first, atol=1e-5)
    assert np.all((seconds > 0.2) & (first > 0.2)) and abs(first[0] - first[1]) > 0.01


def test_the_table_of_races_has_a_row_for_each_randomization():
    own = RaceFlights("±0%", 200, 198, 12.734, 11.79, 31.26, 6.914, 28.0, {"hit a gate": 2})
    none = RaceFlights("±10%", 2, 0, math.nan, math.nan, math.nan, math.nan, 28.0, {})
    lines = race_table([own, none]).splitlines()
    assert "above 28 m/s" in lines[0] and lines[3] == "| ±10% | 0% | - | - | - | - |  |"
    assert lines[2] == "| ±0% | 99% | 12.73 s | 11.79 s | 31.3 m/s | 6.91 s | 2 hit a gate |"
    assert none.to_json()["time"] is None and own.to_json()["finished"] == 198


@pytest.mark.slow
def test_whole_races_of_a_policy(tmp_path):
    file, policy = tmp_path / "found.json", PRETRAINED / "e2e_fastest.npz"
    options = ["--study", "races", "--gates", "6", "--runs", "60", "--json", str(file)]
    assert run(["evaluate", "e2e +fastest", "--policy", str(policy), *options]) == 0
    found = json.loads(file.read_text())["flights"]
    assert [each["label"] for each in found] == ["±0%", "±10%", "±20%", "±30%"]
    assert found[0]["finished"] > found[-1]["finished"]
    assert 2.0 < found[0]["between"] < found[0]["time"] < 4.5
    assert 5.0 < found[0]["highest_speed"] < 15.0 and found[0]["seconds_above"] is None
