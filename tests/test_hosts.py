"""Several processes as one run: the same losses as one process with as many devices."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.learners import hosts
from quadjax.training.metrics import read_metrics
from tests.surface.short import OF_EACH, OF_LEARNER

ROOT = Path(__file__).resolve().parent.parent
OVERRIDES = [*OF_EACH, *OF_LEARNER["ppo"], "name=run"]


def start(runs, *arguments):
    cache = jax.config.jax_compilation_cache_dir
    own = {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": cache}
    script, config = str(ROOT / "scripts/train.py"), str(ROOT / "configs/e2e_ppo.yaml")
    return subprocess.Popen(
        [sys.executable, script, config, *OVERRIDES, *arguments, "--output", str(runs)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env=os.environ | own,
    )


def finish(process, status=0):
    """Wait for a run that has to end with a status; one that does not end is killed."""
    try:
        output, _ = process.communicate(timeout=900)
    finally:
        process.kill()
    assert process.returncode == status, output


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def together(folder, *arguments):
    """Two processes of one device each, to their end."""
    port = free_port()
    both = [
        start(
            folder / str(process),
            "run.devices=1",
            *arguments,
            *("--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process", str(process)),
        )
        for process in range(2)
    ]
    for process in both:
        finish(process)


@pytest.mark.slow
def test_two_processes_are_one_run(tmp_path):
    """Ten updates."""
    alone = start(tmp_path / "alone", "run.devices=2", "run.steps=1280")
    together(tmp_path, "run.steps=1280")
    finish(alone)
    wanted = read_metrics(tmp_path / "alone/run/metrics.csv")
    found = read_metrics(tmp_path / "0/run/metrics.csv")
    assert wanted["steps"].tolist() == found["steps"].tolist() == list(range(128, 1281, 128))
    for name in ("policy_loss", "value_loss", "reward", "approx_kl"):
        np.testing.assert_allclose(found[name], wanted[name], rtol=1e-4, atol=1e-6, err_msg=name)
    summary = json.loads((tmp_path / "0/run/summary.json").read_text())
    assert summary["devices"] == 2 and summary["finished"]
    assert not (tmp_path / "1/run/summary.json").exists()  # the first one writes


@pytest.mark.slow
def test_stopped_in_one_process_all_save_and_go_on(tmp_path):
    """Ctrl-C reaches one process; the first one's checkpoint is what all go on from."""
    arguments = ["run.steps=3840"]

    def both(*more):
        port = free_port()
        there = ("--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process")
        return [start(tmp_path / str(i), *arguments, *there, str(i), *more) for i in range(2)]

    metrics = tmp_path / "0/run/metrics.csv"
    first, second = both()
    deadline = time.monotonic() + 600
    while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.02)
    second.send_signal(signal.SIGINT)
    for process in (second, first):
        finish(process, 130)
    assert not json.loads((tmp_path / "0/run/summary.json").read_text())["finished"]
    for process in both("--resume"):
        finish(process)
    assert json.loads((tmp_path / "0/run/summary.json").read_text())["finished"]
    assert read_metrics(metrics)["steps"].tolist() == list(range(128, 3841, 128))


def test_what_does_not_fit_is_refused():
    for arguments, says in (
        (("nohost", 2, 0), "HOST:PORT"),
        (("host:0", 2, 0), "HOST:PORT"),
        (("host:99999", 2, 0), "HOST:PORT"),
        (("host:5000", None, 0), "--processes"),
        (("host:5000", 2, None), "--process"),
        (("host:5000", 2, 2), "0 to 1"),
        ((None, 2, 0), "--coordinator"),
    ):
        with pytest.raises(InputError, match=says):
            hosts.connect(*arguments)


@pytest.mark.slow
def test_a_process_by_itself_agrees_with_itself():
    hosts.connect(None, None, None)
    assert hosts.alone() and hosts.is_first()
    assert hosts.agree(True) and not hosts.agree(False)
    key = jax.random.key(3)
    np.testing.assert_array_equal(hosts.gather(key), jax.random.key_data(key))
