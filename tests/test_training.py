"""Whole runs: the same bits after a stop, a kill at any moment, and every shipped config."""

import functools
import shutil
import threading
import types
from contextlib import contextmanager

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.mlp import to_layers
from quadjax.core.resources import preset_names
from quadjax.evaluation.evaluate import evaluate
from quadjax.export.race_source import policy_race
from quadjax.learners import loop
from quadjax.learners.schedules import Training
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.training import run as training
from quadjax.training.build import (
    initial_policy,
    make_policy,
    make_training,
    start_state,
    untrained_policy,
)
from tests.surface.short import short_config
from tests.surface.test_training import same
from tests.training.test_folder import NAMED, write_files


def config_of(name, *arguments):
    return short_config(name, "run.checkpoint_seconds=60", *arguments)


def at(steps):
    """Ends a run at its evaluation after ``steps`` steps."""
    return lambda row: row["steps"] >= steps


@contextmanager
def interrupted():
    """Ctrl-C before the training loop, however long the compilation takes."""
    stop = threading.Event()
    stop.set()
    yield stop


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "keys"),
    [
        (
            "e2e_ppo",
            ("run.devices=2", "start.heading=north", "randomization.tracks={count: 3, gates: 4}"),
        ),
        ("e2e +fastest", ("schedules.reward.gate_edge.by=pass_rate",)),
    ],
)
def test_stopped_and_resumed_is_the_same_to_the_bit(tmp_path, monkeypatch, capsys, name, keys):
    """Nothing is compiled after the first chunk."""
    monkeypatch.setattr(training.parallel, "core_count", lambda: 2)  # also where there is but one
    config = config_of(name, *keys)
    compiled, after_chunk = [], []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: event.endswith("backend_compile_duration") and compiled.append(1)
    )
    count = lambda row: after_chunk.append(len(compiled))  # noqa: E731
    monkeypatch.setattr("quadjax.training.progress.LOG_EVERY_S", 0.0)
    whole = training.train(config, tmp_path / "whole", stop_when=count)
    assert f"{config.name}: compiling, " in capsys.readouterr().err
    assert whole.finished
    assert len(after_chunk) == 4 and after_chunk[0] > 0
    assert after_chunk[1:] == after_chunk[:1] * 3
    part = training.train(config, tmp_path / "part", stop_when=at(256))
    assert not part.finished and part.summary["steps"] == 256
    training.train(config, tmp_path / "part", resume=True)
    assert same(whole.folder, part.folder)
    monkeypatch.setattr(training, "_compile", None)  # what is finished compiles nothing again
    again = training.train(config, tmp_path / "part", resume=True)
    assert again.finished and again.summary["steps"] == whole.summary["steps"]


@pytest.mark.slow
def test_the_critic_of_a_file_is_scaled_to_the_unit_of_the_reward(tmp_path):
    path = tmp_path / "first.npz"
    untrained_policy(config_of("e2e_ppo")).save(path)
    config = config_of("e2e", f"run.initial_policy={path}", "learner.reward_scale=0.25")
    run, _ = make_training(config)
    state = start_state(config, run, initial_policy(config))
    file = Policy.load(path)
    scales = [1.0] * (len(file.value) - 1) + [0.25]
    for params in (state.params, state.target, state.ema):
        layers = to_layers(params["critic"])
        for (kernel, bias), (k, b), scale in zip(layers, file.value, scales, strict=True):
            np.testing.assert_allclose(kernel, scale * k, rtol=1e-6)
            np.testing.assert_allclose(bias, scale * b, rtol=1e-6)
    back = make_policy(config, state.params)
    for (kernel, bias), (k, b) in zip(back.value, file.value, strict=True):
        np.testing.assert_allclose(kernel, k, rtol=1e-6)
        np.testing.assert_allclose(bias, b, rtol=1e-6)


@pytest.mark.slow
def test_interrupted_while_compiling_it_saves_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "interruptions", interrupted)
    monkeypatch.setattr(training, "PATIENCE_S", 600.0)
    result = training.train(config_of("e2e_ppo"), tmp_path / "run")
    assert not result.finished and result.summary["steps"] == 0
    assert Policy.load(tmp_path / "run/policy_last.npz").layers


def test_a_run_that_needs_more_memory_than_there_is_is_refused_with_the_estimate(
    tmp_path, monkeypatch
):
    memory = types.SimpleNamespace(total=1000.0)
    monkeypatch.setattr(training.parallel.psutil, "virtual_memory", lambda: memory)
    with pytest.raises(InputError, match=r"about \S+e-0\d GiB .* has \S+e-07 GiB: fewer environ"):
        training.train(config_of("e2e_ppo"), tmp_path / "run", overwrite=True)
    assert not (tmp_path / "run").exists()


def test_interrupted_in_a_long_compilation_it_ends_at_once(tmp_path, monkeypatch):
    finish = threading.Event()
    monkeypatch.setattr(training, "interruptions", interrupted)
    monkeypatch.setattr(training, "PATIENCE_S", 0.0)
    monkeypatch.setattr(training.parallel, "compile_chunk", lambda *_: finish.wait(600))
    with pytest.raises(KeyboardInterrupt):
        training.train(config_of("e2e_ppo"), tmp_path / "run")
    finish.set()


@pytest.mark.slow
def test_a_number_that_is_not_finite_stops_the_run(tmp_path, monkeypatch):
    config = config_of("e2e_ppo")
    compiled, kept = training.parallel.compile_chunk, []

    def broken(*arguments):
        chunk, calls = compiled(*arguments), []

        def run(state):
            state, metrics = chunk(state)
            calls.append(1)
            kept.append(jax.device_get(state.params))
            if len(calls) == 3:
                metrics["value_loss"] = metrics["value_loss"].at[0].set(np.nan)
            return state, metrics

        return run

    monkeypatch.setattr(training.parallel, "compile_chunk", broken)
    config = config.at("run.checkpoint_seconds", 0.0)
    with pytest.raises(loop.NonFiniteError, match="update 3: value_loss"):
        training.train(config, tmp_path / "run")
    monkeypatch.undo()
    monkeypatch.setattr(training, "interruptions", interrupted)
    monkeypatch.setattr(training, "PATIENCE_S", 600.0)
    training.train(config, tmp_path / "run", resume=True)
    saved = Policy.load(tmp_path / "run/policy_last.npz")
    for (kernel, bias), found in zip(to_layers(kept[1]["actor"]), saved.layers, strict=True):
        np.testing.assert_array_equal(kernel, found[0])
        np.testing.assert_array_equal(bias, found[1])


@pytest.mark.slow
def test_a_damaged_checkpoint_is_refused_before_anything_is_compiled(tmp_path, monkeypatch):
    config = config_of("e2e")
    training.train(config, tmp_path, stop_when=at(128))
    for path in (tmp_path / "checkpoints").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    monkeypatch.setattr(training, "_compile", None)
    with pytest.raises(InputError, match=r"checkpoint 128 cannot be read .*--overwrite"):
        training.train(config, tmp_path, resume=True)


TRAINED = {"e2e", "e2e_ppo", "indi_ppo"}  # by other tests
PRESETS = sorted({*preset_names()} - TRAINED)
PRESETS += ["e2e +residual", "e2e_paper +authors_code"]
STANDIN = {"e2e_table1": ["vehicle.residual=standin_residual.npz"]}  # the published one is not here


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_every_shipped_config_has_a_program(name):
    """Two updates at the sizes of the preset are traced; nothing is compiled."""
    config = load_config(name, STANDIN.get(name, []))
    run, _ = make_training(config)
    state = jax.eval_shape(Training.init, run, jax.random.key(0))
    jax.eval_shape(functools.partial(training.parallel.repeat, count=2), run, state)


@pytest.mark.slow
def test_a_moved_run_is_resumed_evaluated_and_exported(tmp_path):
    """Without the files that it was started with; its policy even without its folder."""
    write_files(tmp_path / "files")
    overrides = [f"{key}={tmp_path / 'files' / name}" for key, name in NAMED.items()]
    config = config_of("e2e", *overrides, "network.activation=relu")
    assert not training.train(config, tmp_path / "part", stop_when=at(256)).finished
    shutil.rmtree(tmp_path / "files")
    moved = (tmp_path / "part").rename(tmp_path / "moved")
    resumed = training.train(load_config(moved / "config.yaml"), moved, resume=True)
    assert resumed.finished
    laps = evaluate(moved / "policy.npz", moved / "config.yaml", runs=1, deterministic=True)
    assert laps.lap_times.shape == (1, 1) and len(laps.best.gates) == 2
    alone = (moved / "policy.npz").rename(tmp_path / "alone.npz")
    shutil.rmtree(moved)
    policy = Policy.load(alone)
    found, origin = race_of_policy(policy, alone)
    race = policy_race(found, policy, origin, alone.name)
    assert race.params.vehicle.residual is not None and race.track == "mine"
