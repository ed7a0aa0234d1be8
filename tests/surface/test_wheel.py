"""The wheel, built and used from an empty folder: configs, policies and templates are in it."""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.surface.short import short

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(ROOT)], check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the installed package and nothing of the repository."""
    folder = tmp_path_factory.mktemp("site")
    options = ["--no-deps", "--quiet", "--target", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True)
    return folder


def run(installed, folder, *arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_the_wheel_has_configs_policies_and_templates(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, suffix in (
        ("configs", "yaml"),
        ("pretrained", "npz"),
        ("export/templates", "*"),
        ("view/assets", "*"),
    ):
        own = ROOT / ("configs" if folder == "configs" else f"quadjax/{folder}")
        files = [path for path in own.rglob(f"*.{suffix}") if path.is_file()]
        missing = [p for p in files if f"quadjax/{folder}/{p.relative_to(own)}" not in names]
        assert files and not missing
    assert not [name for name in names if name.startswith(("tests/", "scripts/", "docs/"))]
    assert any(name.endswith("entry_points.txt") for name in names)


def test_it_trains_and_evaluates_in_an_empty_folder(installed, tmp_path):
    where = run(installed, tmp_path, "-c", "import quadjax; print(quadjax.__file__)")
    assert str(installed) in where.stdout
    for arguments in (
        ["train", *short("e2e"), "--name", "first"],
        ["evaluate", "e2e", "--policy", "runs/first/policy.npz", "--laps", "1", "--runs", "2"]
        + ["--json", "laps.json", "--figure", "lap.png"],
    ):
        done = run(installed, tmp_path, "-m", "quadjax", *arguments)
        assert done.returncode == 0, done.stdout + done.stderr
    laps = json.loads((tmp_path / "laps.json").read_text())
    origin = laps["provenance"]
    assert laps["runs"] == 2 and origin["policy"]["file"] == "runs/first/policy.npz"
    assert origin["config"]["name"] == "e2e" and origin["quadjax"]
    assert (tmp_path / "lap.png").stat().st_size > 1000


def test_it_exports_and_verifies_in_an_empty_folder(installed, tmp_path):
    script = "import quadjax\nquadjax.export_c(quadjax.Policy.load('e2e_nominal'), 'c', 'e2e')\n"
    done = run(installed, tmp_path, "-c", script)
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "c").rglob("qj_*.c"))
    done = run(installed, tmp_path, "-m", "quadjax", "verify", "c", "--vectors", "200")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"[1-9]\d* passed, 0 failed, \d+ skipped", done.stdout)
