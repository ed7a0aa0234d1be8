"""Trials as Ray tasks on a cluster of two nodes on this machine, one of which is killed."""

import threading
import time

import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps.run import count, run_sweep
from quadjax.sweeps.study import State
from quadjax.sweeps.sweep import load_sweep
from quadjax.sweeps.workers import make_workers
from tests.sweeps import stand_in
from tests.sweeps.support import ROOT, complete, open_small, sweep_file

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'quadjax[ray]'")
cluster_utils = pytest.importorskip("ray.cluster_utils")
pytestmark = pytest.mark.slow
LIMIT = 600.0


@pytest.fixture
def cluster(monkeypatch):
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


def test_a_node_is_killed_and_its_trial_resumes_on_the_other(tmp_path, cluster):
    nodes, second = cluster
    executor = {"kind": "ray", "address": nodes.address, "retries": 3}
    search = {"method": "random", "pruner": "median"}
    sweep, directory, study = open_small(
        tmp_path, executor=executor, search=search, budget={"trials": 3}
    )

    def kill() -> None:
        deadline = time.monotonic() + LIMIT
        while len(list(directory.glob("trials/*/ticks"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        nodes.remove_node(second, allow_graceful=False)

    workers = make_workers(sweep.file.executor, directory)
    assert workers.count == 2
    killer = threading.Thread(target=kill)
    killer.start()
    assert run_sweep(sweep, directory, workers, stand_in.measure)
    killer.join()
    states = [trial.state for trial in study.get_trials()]
    assert states.count(State.FAIL) >= 1 and count(study).done == 3 and count(study).failed == 0
    assert all(trial.intermediate_values for trial in complete(study))
    workers = sorted(len(p.read_text().split()) for p in directory.glob("trials/*/workers"))
    assert workers[-1] >= 2  # the trial of the killed node
    assert [p.read_text() for p in directory.glob("trials/*/ticks")] == ["10"] * 3

    too_large = load_sweep(sweep_file(tmp_path), ["executor.kind=ray", "executor.gpus=2"])
    with pytest.raises(InputError, match="no node has 1 CPUs and 2 GPUs"):
        make_workers(too_large.file.executor, directory)
