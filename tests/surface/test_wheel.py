"""The wheel, built and used from an empty folder: every file of the package is in it."""

import json
import os
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


def test_the_wheel_has_every_file_of_the_package_and_the_configs(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, place in (("quadjax", "quadjax"), ("configs", "quadjax/configs")):
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file()]
        own = {f"{place}/{path.relative_to(ROOT / folder).as_posix()}" for path in files}
        assert len(own) > 20 and {x for x in own - names if "__pycache__" not in x} == set()
    assert not [name for name in names if name.startswith(("tests/", "scripts/", "docs/"))]
    assert any(name.endswith("entry_points.txt") for name in names)


def test_it_trains_and_evaluates_in_an_empty_folder(installed, tmp_path):
    where = run(installed, tmp_path, "-c", "import quadjax; print(quadjax.__file__)")
    assert str(installed) in where.stdout
    for arguments in (
        ["train", *short("e2e"), "--name", "first"],
        ["evaluate", "e2e", "--policy", "runs/first/policy.npz", "--laps", "1", "--runs", "2"]
        + ["--json", "laps.json", "--figures", "lap"],
    ):
        done = run(installed, tmp_path, "-m", "quadjax", *arguments)
        assert done.returncode == 0, done.stdout + done.stderr
    laps = json.loads((tmp_path / "laps.json").read_text())
    origin = laps["provenance"]
    assert laps["runs"] == 2 and origin["policy"]["file"] == "runs/first/policy.npz"
    assert origin["config"]["name"] == "e2e" and origin["quadjax"]
    assert (tmp_path / "lap/trajectory.png").stat().st_size > 1000


def test_it_exports_in_an_empty_folder(installed, tmp_path):
    done = run(installed, tmp_path, "-m", "quadjax", "export", "e2e", "--output", "c")
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "c").rglob("qj_*.c"))
