"""A full disk at many points of a run: one line, status 2, nothing half-written, and it resumes."""

import json
import os

import pytest

from quadjax.policy.file import Policy
from quadjax.training.metrics import saved_rows
from tests.commands import run
from tests.sweeps.support import TINY

resource = pytest.importorskip("resource", reason="limits of a process need POSIX")

SIZES = [int(size) for size in os.environ.get("QUADJAX_TEST_SIZES", "0 40 400 4000 9000").split()]
OVERRIDES = [f"learner.{key}={value}" for key, value in TINY["learner"].items()]
OVERRIDES += ["network.hidden=[8]", "run.steps=512", "run.evaluate_every=128", "evaluate.laps=1"]
OVERRIDES += ["run.checkpoint_seconds=0", "run.compilation_cache=false", "run.devices=1"]


@pytest.fixture
def limit():
    """A function that limits the size of every file; no limit afterwards."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(
        resource.RLIMIT_FSIZE, (soft if size is None else size, hard)
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_a_full_disk_is_one_line_and_the_run_resumes(tmp_path, capfd, limit, size):
    command = (
        "train",
        "e2e_ppo",
        *OVERRIDES,
        "name=one",
        "--output",
        tmp_path / "runs",
        "--resume",
    )
    limit(size)
    status = run(*command)
    limit(None)
    error = capfd.readouterr().err
    assert "Traceback" not in error and "Event loop" not in error and "ignored" not in error
    lines = [line for line in error.splitlines() if line.startswith("error: ")]
    assert (status, len(lines)) == (2, 1) and "File too large" in lines[0], error
    folder = tmp_path / "runs" / "one"
    for path in folder.glob("*.npz"):
        Policy.load(path)
    for path in folder.glob("*.json"):
        json.loads(path.read_text())
    saved_rows(folder / "metrics.csv")
    assert run(*command) == 0
    assert [row["steps"] for row in saved_rows(folder / "metrics.csv")] == [128, 256, 384, 512]
    assert not list(folder.rglob(".writing-*"))
