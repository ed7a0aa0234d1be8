"""Whole sweeps in processes and on Ray: pinned workers, killed workers, sweeps and nodes."""

import os
import signal
import subprocess
import sys
import threading
import time

import psutil
import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Executor
from quadjax.sweeps.study import State, open_study, trials_over
from quadjax.sweeps.sweep import load_sweep
from quadjax.sweeps.workers import LocalWorkers, RayWorkers
from tests.surface.test_training import wait_for
from tests.sweeps import stand_in
from tests.sweeps.stand_in import (
    CLIP,
    RATE,
    ROOT,
    complete,
    open_small,
    run_small,
    sweep_file,
    value_of,
)

LIMIT = 600.0  # s, for whatever a test waits for


def start(path, runs, *overrides, seconds=0.2) -> subprocess.Popen:
    """A sweep whose training is a sleep, in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.sweeps.stand_in", str(path), str(runs), *overrides],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "STAND_IN_SECONDS": str(seconds)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def lines(folder, name) -> list[str]:
    """The lines of a file in every trial's folder."""
    return [line for path in folder.glob(f"trials/*/{name}") for line in path.read_text().split()]


@pytest.mark.slow
def test_an_interrupted_sweep_resumes(tmp_path):
    path, folder = sweep_file(tmp_path, budget={"trials": 6}), tmp_path / "runs" / "small"
    process = start(path, tmp_path / "runs", seconds=1.0)
    wait_for(lambda: lines(folder, "workers"), process)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 130 and "The same command runs the rest." in output, output
    assert (folder / "report.md").exists()
    process = start(path, tmp_path / "runs")
    output, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0 and "6/6 trials, best" in output, output
    trials = complete(open_study(load_sweep(path), folder))
    assert all(t.value == pytest.approx(value_of(t.params)) for t in trials)
    assert len({tuple(t.params.values()) for t in trials}) == 6
    assert lines(folder, "ticks") == ["10"] * 6  # each resumed in its folder
    assert len(lines(folder, "workers")) > 6


@pytest.mark.slow
@pytest.mark.parametrize("deaths", [1, 2])
def test_a_trial_is_retried_after_its_worker_died_and_given_up_the_second_time(tmp_path, deaths):
    path, folder = sweep_file(tmp_path, budget={"trials": 1}), tmp_path / "runs" / "small"
    process = start(path, tmp_path / "runs", "executor.workers=1", seconds=1.0)
    for death in range(deaths):
        wait_for(lambda n=death: len(lines(folder, "workers")) > n, process)
        os.kill(int(lines(folder, "workers")[death]), signal.SIGKILL)
    output, _ = process.communicate(timeout=LIMIT)
    assert "worker died (exit code -9; see" in output
    study = open_study(load_sweep(path), folder)
    trials = study.get_trials()
    assert trials[0].state == State.FAIL and trials[-1].params == trials[0].params
    state = State.COMPLETE if deaths == 1 else State.FAIL
    assert [t.state for t in trials_over(study)] == [state]
    assert process.returncode == deaths - 1 and "its worker died" * (deaths - 1) in output


@pytest.mark.slow
def test_workers_are_pinned_and_end_with_the_sweep(tmp_path):
    process = start(sweep_file(tmp_path), tmp_path / "runs", seconds=2.0)
    cores = psutil.Process().cpu_affinity()
    folder, most = tmp_path / "runs" / "small", min(4, len(cores))
    wait_for(lambda: len(lines(folder, "workers")) >= most, process)
    workers = [psutil.Process(int(pid)) for pid in set(lines(folder, "workers"))]
    assert sorted(w.cpu_affinity() for w in workers) == [[core] for core in cores[:most]]
    process.kill()
    gone, alive = psutil.wait_procs(workers, timeout=LIMIT)
    assert len(gone) == most and not alive


@pytest.mark.slow
def test_trials_are_pruned_or_fail_and_a_budget_of_time_ends_the_sweep(tmp_path):
    search = {"method": "random", "pruner": "halving"}
    sweep, directory, study = open_small(tmp_path, search=search, budget={"trials": 6})
    assert run_small(sweep, directory, stand_in.measure)
    pruned = [t for t in study.get_trials() if t.state == State.PRUNED]
    assert pruned and len(trials_over(study)) == 6 and all(t.intermediate_values for t in pruned)
    assert min(t.value for t in complete(study)) <= min(t.value for t in pruned)

    space = {CLIP: {"choices": [0.1, 0.3]}, RATE: {"choices": [1e-3, 1e-2]}}
    grid = {"search": {"method": "grid"}, "space": space}
    sweep, directory, study = open_small(tmp_path, name="failing", **grid)
    assert run_small(sweep, directory, stand_in.impossible)
    failed = [t for t in trials_over(study) if t.state == State.FAIL]
    points = [(t.state == State.FAIL, *t.params.values()) for t in trials_over(study)]
    assert len(points) == len(set(points)) == 4 and sum(point[0] for point in points) == 2
    assert failed[0].user_attrs["error"] == "track: the gates overlap"

    sweep, directory, study = open_small(tmp_path, "budget.seconds=1e-3", name="short")
    assert run_small(sweep, directory, stand_in.measure)
    assert len(trials_over(study)) < 4


@pytest.mark.slow
def test_each_worker_sees_its_gpu_and_more_workers_than_room_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    for executor, message in (
        (Executor(workers=4000), r"executor.workers is 4000, allowed: up to \d+, the cores"),
        (Executor(gpus=3), "allowed: up to 0, room on 2 GPUs for executor.gpus 3"),
    ):
        with pytest.raises(InputError, match=message):
            LocalWorkers(executor, tmp_path)
    changes = ["executor.gpus=1", "executor.workers=2", "budget.trials=2"]
    sweep, directory, _ = open_small(tmp_path, *changes)
    assert run_small(sweep, directory, _wait_for_both)
    assert sorted(path.read_text() for path in directory.glob("gpu*")) == ["3", "5"]


def _wait_for_both(sweep, params, seed, folder, stop_when):
    folder = folder.parents[2]
    (folder / f"gpu{os.getpid()}").write_text(os.environ["CUDA_VISIBLE_DEVICES"])
    deadline = time.monotonic() + 60.0
    while len(list(folder.glob("gpu*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    return 1.0, 1.0


@pytest.mark.slow
def test_two_machines_share_a_database_and_one_takes_over_a_silent_trial(tmp_path, monkeypatch):
    monkeypatch.setattr("quadjax.sweeps.study.HEARTBEAT_S", 1)
    monkeypatch.setattr("quadjax.sweeps.study.GRACE_S", 2)
    entries = {"storage": f"sqlite:///{tmp_path}/study.db", "executor": {"workers": 1}}
    sweep, _, study = open_small(tmp_path / "a", **entries)
    silent = study.ask()
    params = sweep.suggest(silent)
    study._storage.record_heartbeat(silent._trial_id)  # as the machine that dies now did
    other = threading.Thread(target=run_small, args=(sweep, tmp_path / "b", stand_in.measure))
    other.start()
    assert run_small(sweep, tmp_path / "a", stand_in.measure)
    other.join()
    assert len(complete(study)) == 4
    assert study.get_trials()[0].state == State.FAIL
    assert params in [trial.params for trial in complete(study)]


@pytest.fixture
def cluster(monkeypatch):
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'quadjax[ray]'")
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("STAND_IN_SECONDS", "6")  # of a trial in a Ray worker
    nodes = cluster_utils.Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "include_dashboard": False, "object_store_memory": 10**8},
    )
    second = nodes.add_node(num_cpus=1, object_store_memory=10**8)
    nodes.wait_for_nodes()
    try:
        yield nodes, second
    finally:
        ray.shutdown()
        nodes.shutdown()


@pytest.mark.slow
def test_a_node_is_killed_and_its_trial_resumes_on_the_other(tmp_path, cluster):
    nodes, second = cluster
    executor = {"kind": "ray", "address": nodes.address, "retries": 3}
    sweep, directory, study = open_small(tmp_path, executor=executor, budget={"trials": 3})

    def kill() -> None:
        deadline = time.monotonic() + LIMIT
        while len(list(directory.glob("trials/*/ticks"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        nodes.remove_node(second, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    assert run_small(sweep, directory, stand_in.measure)
    killer.join()
    states = [trial.state for trial in study.get_trials()]
    assert states.count(State.FAIL) >= 1 and len(complete(study)) == 3
    workers = sorted(len(p.read_text().split()) for p in directory.glob("trials/*/workers"))
    assert workers[-1] >= 2  # the trial of the killed node
    assert [p.read_text() for p in directory.glob("trials/*/ticks")] == ["10"] * 3

    with pytest.raises(InputError, match="no node has 1 CPUs and 2 GPUs"):
        RayWorkers(Executor(kind="ray", gpus=2))
