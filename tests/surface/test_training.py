"""Trainings by commands and by functions: their files, a stop, a kill, and a resume to the bit."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import chex
import jax
import numpy as np
import pytest

import quadjax
from tests.commands import run
from tests.surface.short import short, short_config

ROOT = Path(__file__).resolve().parents[2]
CLOCK = re.compile("second|memory")  # columns of metrics.csv that differ between equal runs


def weights(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a policy file."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "meta"}


def metrics(folder: Path) -> list[dict[str, str]]:
    """The rows of a run's metrics without the columns of the clock."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if not CLOCK.search(k)} for row in csv.DictReader(file)
        ]


def same(one: Path, other: Path) -> bool:
    """Whether two runs have the same policies and metrics, bit for bit."""
    for name in ("policy.npz", "policy_last.npz"):
        first, second = weights(one / name), weights(other / name)
        if first.keys() != second.keys():
            return False
        if not all(np.array_equal(first[key], second[key]) for key in first):
            return False
    return metrics(one) == metrics(other)


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """``quadjax ARGUMENTS`` as a process in a folder."""
    return subprocess.Popen(
        [sys.executable, "-m", "quadjax", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )


def written(file: Path) -> int:
    """When a file was written, ns; 0: not yet."""
    return file.stat().st_mtime_ns if file.exists() else 0


def wait_for(condition, process: subprocess.Popen, seconds: float = 300.0) -> None:
    """Wait until a condition holds while a process runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, (process.stderr or process.stdout).read()
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.slow
def test_a_folder_of_a_run_is_resumed_or_replaced_only_if_asked(
    trained, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(trained, tmp_path / "runs/trained")
    for name in ("config.yaml", "metrics.csv", "policy.npz", "policy_last.npz", "summary.json"):
        assert (folder / name).stat().st_size > 0
    command = ("train", *short("e2e"), "--name", "trained")
    assert run(*command) == 2
    assert "--resume" in capfd.readouterr().err
    assert run(*command, "seed=1", "--resume") == 2
    assert "seed" in capfd.readouterr().err
    assert run(*command, "--resume") == 0
    again = "the run is finished (512 steps); --overwrite trains again"
    assert f"runs/trained: {again}" in capfd.readouterr().err
    assert run(*command, "seed=1", "vehicle.constants.tau=0.4", "--overwrite") == 0
    assert "warning: Parrot Bebop 1: tau 0.4 s: typical values" in capfd.readouterr().err
    assert not same(trained, folder)


@pytest.mark.slow
def test_a_run_that_was_stopped_twice_resumes_to_the_same_bits(tmp_path):
    words = ("indi_ppo", "run.steps=2048")
    whole = quadjax.train(short_config(*words), tmp_path / "runs/whole")
    folder = tmp_path / "runs/part"
    command, resume, saved = ("train", *short(*words), "--name", "part"), (), 0
    for end, status in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        process, resume = start(tmp_path, *command, *resume), ("--resume",)
        wait_for(lambda: written(folder / "policy_last.npz") > saved, process)  # noqa: B023
        process.send_signal(end)
        process.wait(60)
        assert process.returncode == status
        saved = written(folder / "policy_last.npz")
    process = start(tmp_path, *command, *resume)
    assert process.wait(300) == 0, process.stderr.read()
    assert same(whole.folder, folder)


@pytest.mark.slow
def test_a_run_in_python_is_that_of_the_command_to_the_bit(trained, tmp_path):
    result = quadjax.train(short_config("e2e"), tmp_path / "run", progress=False)
    assert same(trained, result.folder)
    assert result.finished and result.folder == tmp_path / "run"
    assert result.metrics["steps"].tolist() == [128, 256, 384, 512]
    summary = json.loads((result.folder / "summary.json").read_text())
    assert summary["steps"] == 512 and summary["seed"] == 0
    again = quadjax.Run.load(result.folder)
    assert again.config == result.config and again.summary == summary
    saved = quadjax.Policy.load(result.folder / "policy.npz")
    observation = np.linspace(-1.0, 1.0, saved.layout.size, dtype=np.float32)
    action = np.asarray(saved.mean(observation))
    np.testing.assert_array_equal(action, np.asarray(result.policy.mean(observation)))
    assert action.shape == (4,) and np.abs(action).max() <= 1.0


def test_the_race_is_three_pure_functions_and_numbers_compile_nothing_again():
    config = short_config("e2e")
    environment, params = quadjax.make_race(config)
    transition = jax.jit(chex.assert_max_traces(environment.step, n=1))
    state = environment.reset(params, jax.random.key(0))
    observation = environment.observe(params, state)
    action = np.zeros(4, np.float32)
    first = transition(params, state, action)
    again = transition(params, state, action)
    chex.assert_trees_all_equal(first[1:], again[1:])
    other = quadjax.make_race(
        short_config("e2e", "reward.body_rates=0.01", "vehicle.constants.k_w=3e-8")
    )[1]
    changed = transition(other, state, action)
    assert not np.array_equal(first[1], changed[1])
    assert observation.ndim == 1 and observation.dtype == np.float32
    assert first[1].shape == () and first[2].dtype == bool and first[3].dtype == bool


@pytest.mark.slow
def test_a_learner_repeats_itself_to_the_bit():
    environment, params = quadjax.make_race(short_config("e2e"))
    learner = quadjax.SHAC(num_envs=16, horizon=4, critic_minibatches=2, critic_epochs=1)
    result = learner.train(environment, params, steps=128, seed=0)
    repeated = learner.train(environment, params, steps=128, seed=0)
    chex.assert_trees_all_equal(result.parameters, repeated.parameters)
    assert result.steps == 128 and result.metrics["reward"].shape == (2,)
