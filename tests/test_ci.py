"""CI fails on a tool that cannot be installed, and on a skip that is not allowed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SKIP = "import pytest\n\ndef test_one():\n    pytest.skip({!r})\n\ndef test_two():\n    pass\n"
ALLOWED = {"test_gym.py": SKIP.format("the extra sb3 is not installed")}
OTHERS = {  # another test, another reason, a module
    "test_other.py": ALLOWED["test_gym.py"],
    "test_gym.py": SKIP.format("no gcc on this machine"),
    "test_module.py": "import pytest\npytest.importorskip('no_such_module')\n",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "in_ci", "status"), [(ALLOWED, True, 0), (OTHERS, True, 1), (OTHERS, False, 0)]
)
def test_a_skip_in_ci_is_in_the_list_or_fails(files, in_ci, status, tmp_path):
    (tmp_path / "tests").mkdir()
    for name, code in files.items():
        (tmp_path / "tests" / name).write_text(code)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    environment = {key: value for key, value in os.environ.items() if key != "CI"}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "tests.skips", "-n", "1", "tests"],
        cwd=tmp_path,
        env=environment | {"PYTHONPATH": str(ROOT)} | ({"CI": "true"} if in_ci else {}),
        capture_output=True,
        text=True,
    )
    assert done.returncode == status, done.stdout
    for name in files:
        assert (f"not allowed in CI to skip tests/{name}" in done.stdout) == (status == 1)


@pytest.mark.parametrize("status", [0, 1])
def test_ci_fails_where_a_tool_cannot_be_installed(status, tmp_path):
    """The script with programs that only write down that they were called."""
    log = f'echo "$(basename "$0") $1" >> {tmp_path / "log"}\n'
    programs = {
        "id": "echo 0",
        "dpkg-query": '[ "${!#}" != chromium ] && echo "install ok installed"',
        "apt-get": f"{log}exit {status}",
        "make": log,
        "sleep": "",
    }
    for name, code in programs.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{code}\n")
        (tmp_path / name).chmod(0o755)
    done = subprocess.run(
        [ROOT / ".ci" / "run"],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
    )
    calls = (tmp_path / "log").read_text().splitlines()
    assert done.returncode == status
    if status:
        assert done.stdout == "cannot install: chromium\n"
        assert calls == ["apt-get update"] * 3
    else:
        tests = ["make setup", "make betaflight", "make test", "make test-slow"]
        assert calls == ["apt-get update", "apt-get install", *tests]
