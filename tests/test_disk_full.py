"""A full disk at several points of a run: one line, status 2, nothing half-written, a resume."""

import contextlib
import json

import jax
import pytest

from quadjax.policy.file import Policy
from quadjax.training.result import saved_rows
from tests.commands import run
from tests.surface.short import short

resource = pytest.importorskip("resource", reason="limits of a process need POSIX")

SIZES = [4000, 20_000]  # largest files, bytes: of a policy, a checkpoint


@contextlib.contextmanager
def largest_files(size):
    """No file becomes larger, and no compiled program is kept, which would be cut off."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before, (soft, hard) = getattr(jax.config, name), resource.getrlimit(resource.RLIMIT_FSIZE)
    jax.config.update(name, float("inf"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        jax.config.update(name, before)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_a_full_disk_is_one_line_and_the_run_resumes(tmp_path, capsys, size):
    folder = tmp_path / "runs" / "one"
    command = ["train", *short("e2e_ppo", "name=one"), "--output", folder.parent, "--resume"]
    with largest_files(size):
        assert run(*command) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if line.startswith("error: ")]) == 1
    assert not [line for line in lines if "Traceback" in line]
    for path in folder.glob("*.npz"):
        Policy.load(path)
    for path in folder.glob("*.json"):
        json.loads(path.read_text())
    saved_rows(folder / "metrics.csv")
    assert run(*command) == 0
    assert [row["steps"] for row in saved_rows(folder / "metrics.csv")] == [128, 256, 384, 512]
    assert not list(folder.rglob(".writing-*"))
