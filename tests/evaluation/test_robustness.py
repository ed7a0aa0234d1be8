"""The protocol of flights with randomized constants."""

import json
import math

import jax
import numpy as np
import pytest

from quadjax.cli import run
from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.resources import PRETRAINED
from quadjax.studies.robustness import Flights, spread_table, start_before_gate
from tests import reference as ref
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
    flights = [Flights("±0%", 200, 5, 1.51), Flights("±10%", 200, 200, math.nan)]
    lines = spread_table(flights, "mine").splitlines()
    assert (
        lines[0] == "| policy | ±0% | ±10% |" and lines[2] == "| mine | 2.5% / 1.510 s | 100% / - |"
    )
    assert flights[1].to_json()["lap"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robustness", "--laps", "3"], "--laps is not allowed with --robustness"),
        (["--robustness", "--figure", "x.png"], "--figure is not allowed with --robustness"),
        (["--seconds", "3"], "--seconds is allowed only with --robustness"),
    ],
)
def test_options_without_effect_are_refused(options, message, capsys):
    assert run(["evaluate", "e2e_shac", "--policy", "none.npz", *options]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_more_drones_crash_with_larger_errors(tmp_path, capsys):
    file, policy = tmp_path / "found.json", PRETRAINED / "e2e_fastest.npz"
    options = ["--robustness", "--runs", "60", "--seconds", "7", "--json", str(file)]
    command = ["evaluate", "e2e_fastest", "--policy", str(policy), *options]
    assert run(command) == 0
    assert "| e2e_fastest | " in capsys.readouterr().out
    found = json.loads(file.read_text())["flights"]
    assert [each["label"] for each in found] == ["±0%", "±10%", "±20%", "±30%"]
    assert found[0]["crashed"] < found[-1]["crashed"] <= 60
    assert 1.9 < found[0]["lap"] < 2.3
