"""Programs with JAX's 64-bit types get the same numbers from quadjax as others, to the bit."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import quadjax
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.summary import summarize
from tests.surface.short import short


@pytest.fixture
def both():
    """What calls a function without and with 64-bit types."""

    def call(function):
        results = []
        for enabled in (False, True):
            jax.config.update("jax_enable_x64", enabled)
            results.append(jax.tree.map(np.asarray, function()))
        return results

    yield call
    jax.config.update("jax_enable_x64", False)


def laps():
    return quadjax.evaluate("indi", "indi", laps=1, runs=2).totals


def race():
    environment, params = quadjax.make_race("e2e")
    action = np.zeros(4, np.float32)

    def step(state, _):
        state, *rest = environment.step(params, state, action)
        return state, (environment.observe(params, state), *rest)

    state = jax.jit(environment.reset)(params, jax.random.key(0))
    return jax.jit(lambda state: jax.lax.scan(step, state, None, length=3)[1])(state)


def vectors():
    gymnasium = pytest.importorskip("gymnasium", reason="the extra gym is not installed")
    from quadjax.integrations import gym

    envs = gymnasium.make_vec(gym.ID, num_envs=2)
    return envs.reset(seed=1)[0], envs.step(np.zeros((2, 4)))[:2]


def action():
    return quadjax.Policy.load("e2e")(np.ones(24))


def summary():
    config = quadjax.load("e2e_race", ["vehicle=5inch"])
    made = summarize(base_model(config.vehicle.model), config.vehicle.constants)
    return [np.frombuffer("".join(made.lines).encode(), np.uint8)]


@pytest.mark.parametrize("function", [laps, race, vectors, action, summary])
def test_the_numbers_are_those_of_single_precision(function, both):
    single, double = both(function)
    jax.tree.map(np.testing.assert_array_equal, single, double)
    assert [x.dtype for x in jax.tree.leaves(single)] == [x.dtype for x in jax.tree.leaves(double)]


@pytest.mark.slow
def test_a_training_is_that_of_single_precision(both, tmp_path):
    """Its threads compile in single precision too."""
    name, *words = short("e2e")

    def trained():
        folder = tmp_path / str(jax.config.values["jax_enable_x64"])
        return quadjax.train(quadjax.load(name, words), folder, progress=False).policy.layers

    jax.tree.map(np.testing.assert_array_equal, *both(trained))


@pytest.mark.slow
def test_a_command_is_that_of_single_precision(tmp_path):
    command = [sys.executable, "-m", "quadjax", "evaluate", "--policy", "indi", "--laps", "1"]
    laps = []
    for enabled in "01":
        environment = {"JAX_ENABLE_X64": enabled, "PYTHONPATH": str(Path(__file__).parents[1])}
        done = subprocess.run(
            [*command, "--runs", "2", "--json", f"{enabled}.json"],
            cwd=tmp_path,
            env=os.environ | environment,
            capture_output=True,
        )
        assert done.returncode == 0, done.stderr
        laps.append(json.loads((tmp_path / f"{enabled}.json").read_text())["laps"])
    assert laps[0] == laps[1] and len(laps[0]) == 2
