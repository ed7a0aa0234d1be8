"""A sweep that is killed resumes with the trials that it had."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from tests.surface.short import OF_EACH, OF_LEARNER

ROOT = Path(__file__).resolve().parents[2]


def overrides() -> dict[str, object]:
    """The short training as a sweep file has it."""
    pairs = (word.partition("=") for word in (*OF_EACH, *OF_LEARNER["ppo"]))
    return {key: yaml.safe_load(value) for key, _, value in pairs if key != "run.devices"}


@pytest.mark.slow
def test_a_killed_sweep_resumes(tmp_path):
    sweep = {
        "name": "small",
        "config": "e2e_ppo",
        "overrides": overrides(),
        "space": {"learner.learning_rate": {"choices": [1e-4, 3e-4, 1e-3, 3e-3]}},
        "search": {"method": "grid"},
        "objective": {"seeds": 1, "runs": 2},
    }
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(sweep))
    command = [sys.executable, "-m", "quadjax", "sweep", "small.yaml", "--workers", "1"]
    settings = {
        "cwd": tmp_path,
        "env": os.environ | {"PYTHONPATH": str(ROOT)},
        "stderr": subprocess.PIPE,
        "text": True,
    }
    process = subprocess.Popen(command, **settings, start_new_session=True)
    end = time.monotonic() + 300
    while not list((tmp_path / "runs/small").glob("**/policy.npz")):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(30)
    done = subprocess.run(command, **settings, timeout=500)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "runs/small/trials.csv").open(newline="") as file:
        trials = list(csv.DictReader(file))
    rates = sorted(float(trial["learner.learning_rate"]) for trial in trials)
    assert rates == sweep["space"]["learner.learning_rate"]["choices"]
    assert not any(trial["error"] for trial in trials)
