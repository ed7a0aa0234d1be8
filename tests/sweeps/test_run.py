"""Whole sweeps: workers killed at any moment, the sweep killed and started again."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import jax
import pytest

from quadjax.config.loading import load_config
from quadjax.sweeps.report import results_of
from quadjax.sweeps.schema import load_sweep
from quadjax.sweeps.store import State, Store
from tests.sweeps.support import ROOT, sweep_file, value_of

LIMIT = 300.0  # s, for whatever a test waits for


def environment(seconds: float = 0.3) -> dict[str, str]:
    cache = jax.config.jax_compilation_cache_dir
    own = {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": cache}
    return os.environ | own | {"STAND_IN_SECONDS": str(seconds)}


def start(path, runs, workers=2, seconds=0.3) -> subprocess.Popen:
    """A sweep whose training is a sleep, in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.sweeps.stand_in", str(path), str(runs), str(workers)],
        cwd=ROOT,
        env=environment(seconds),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def open_at(path, runs) -> Store:
    sweep = load_sweep(path)
    return Store(sweep, runs / sweep.file.name)


def wait_for(what, process=None):
    deadline = time.monotonic() + LIMIT
    while time.monotonic() < deadline:
        if found := what():
            return found
        if process is not None and process.poll() is not None:
            raise AssertionError(process.stdout.read())
        time.sleep(0.05)
    raise AssertionError("waited in vain")


def running(store: Store) -> list[dict]:
    """The workers of running trials."""
    return [
        t.user_attrs["worker"]
        for t in store.trials()
        if t.state == State.RUNNING and "worker" in t.user_attrs
    ]


@pytest.mark.slow
def test_killed_at_random_and_started_again_nothing_is_lost(tmp_path):
    """SIGKILL to the sweep in the midst of its trials, three times."""
    path, clock = sweep_file(tmp_path, budget={"trials": 10}), random.Random(1)
    store = open_at(path, tmp_path / "runs")
    for _ in range(3):
        before = store.counts().done
        process = start(path, tmp_path / "runs")
        wait_for(lambda b=before: store.counts().done > b or store.counts().open == 0, process)
        time.sleep(clock.uniform(0.0, 0.3))
        process.kill()
        process.wait()
    process = start(path, tmp_path / "runs")
    output, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, output
    complete = [t for t in store.trials() if t.state == State.COMPLETE]
    assert sorted(t.user_attrs["slot"] for t in complete) == list(range(10))
    assert all(t.value == pytest.approx(value_of(t.params)) for t in complete)
    # Random search from one seed: what was interrupted kept its parameters.
    assert len({tuple(t.params.values()) for t in complete}) == 10


@pytest.mark.slow
def test_a_worker_killed_in_a_trial_leaves_it_failed_and_tried_once_more(tmp_path):
    path = sweep_file(tmp_path, budget={"trials": 2})
    store = open_at(path, tmp_path / "runs")
    process = start(path, tmp_path / "runs", workers=1, seconds=2.0)
    wait_for(lambda: any(len(trial.params) == 2 for trial in store.trials()), process)
    os.kill(running(store)[0]["pid"], signal.SIGKILL)
    output, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, output
    failed = [t for t in store.trials() if t.state == State.FAIL]
    complete = [t for t in store.trials() if t.state == State.COMPLETE]
    assert len(failed) == 1 and failed[0].user_attrs["error"] == "worker died"
    assert sorted(t.user_attrs["slot"] for t in complete) == [0, 1]
    again = next(t for t in complete if t.user_attrs["slot"] == failed[0].user_attrs["slot"])
    assert again.user_attrs["attempt"] == 1 and again.params == failed[0].params


@pytest.mark.slow
def test_a_trial_that_kills_two_workers_is_given_up(tmp_path):
    path = sweep_file(tmp_path, budget={"trials": 1})
    store = open_at(path, tmp_path / "runs")
    process = start(path, tmp_path / "runs", workers=1, seconds=3.0)
    first = wait_for(lambda: running(store), process)[0]
    os.kill(first["pid"], signal.SIGKILL)
    second = wait_for(lambda: [w for w in running(store) if w["pid"] != first["pid"]], process)[0]
    os.kill(second["pid"], signal.SIGKILL)
    process.communicate(timeout=LIMIT)
    assert process.returncode == 1
    assert store.counts().failed == 1
    assert [r.error for r in results_of(store)] == ["worker died"]


@pytest.mark.slow
def test_a_whole_sweep_by_its_command(tmp_path):
    """Real training; then the best config trains by itself."""
    path = sweep_file(tmp_path, budget={"trials": 3}, search={"method": "tpe", "pruner": "median"})
    runs = tmp_path / "runs"

    def command(script, *arguments):
        return subprocess.run(
            [
                sys.executable,
                str(ROOT / "scripts" / script),
                *map(str, arguments),
                "--output",
                runs,
            ],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env=environment(),
        )

    done = command("sweep.py", path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3/3 trials" in done.stderr
    folder = runs / "small"
    for name in ("report.md", "trials.csv", "best.yaml", "parallel.png", "slices.png"):
        assert (folder / name).stat().st_size > 0
        assert name != "report.md" or "learning_rate" in (folder / name).read_text()
    best = results_of(open_at(path, runs))[0]
    config = load_config(folder / "best.yaml")
    assert config.ppo.clip == best.params["ppo.clip"] and config.name == "small_best"
    assert config.train.drones == 16
    for slot in range(3):
        own = load_config(folder / f"trials/{slot:04d}/seed0/config.yaml")
        assert own.train.devices == "1"
        summary = json.loads((folder / f"trials/{slot:04d}/seed0/summary.json").read_text())
        assert summary["devices"] == 1
    trained = command("train.py", folder / "best.yaml", "train.devices=1")
    assert trained.returncode == 0, trained.stderr
    again = command("sweep.py", path)
    assert again.returncode == 0 and len(open_at(path, runs).trials()) == 3
