"""A full disk at several points of a run: one line, status 2, nothing half-written, a resume."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from quadjax.policy.file import Policy
from quadjax.training.result import saved_rows
from tests.commands import run
from tests.surface.short import short

resource = pytest.importorskip("resource", reason="limits of a process need POSIX")

ROOT = Path(__file__).resolve().parents[1]
SIZES = [4000, 20_000]  # largest files, bytes: of a policy, a checkpoint


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_a_full_disk_is_one_line_and_the_run_resumes(tmp_path, size):
    folder = tmp_path / "runs" / "one"
    # Compiled programs are read from the cache of all tests; those that are cut off stay apart.
    (tmp_path / "c").mkdir()
    for path in Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).glob("*-cache"):
        (tmp_path / "c" / path.name).symlink_to(path.resolve())
    own = ("run.compilation_cache=false", "name=one")
    command = ["train", *short("e2e_ppo", *own), "--output", folder.parent, "--resume"]
    done = subprocess.run(
        [sys.executable, "-m", "quadjax", *map(str, command)],
        capture_output=True,
        text=True,
        env=os.environ
        | {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "c")},
        cwd=tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 2 and len(errors) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for path in folder.glob("*.npz"):
        Policy.load(path)
    for path in folder.glob("*.json"):
        json.loads(path.read_text())
    saved_rows(folder / "metrics.csv")
    assert run(*command) == 0
    assert [row["steps"] for row in saved_rows(folder / "metrics.csv")] == [128, 256, 384, 512]
    assert not list(folder.rglob(".writing-*"))
