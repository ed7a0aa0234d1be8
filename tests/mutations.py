"""Plant small faults in a copy of the repository, one at a time, and count those that tests catch.

    python -m tests.mutations --tier all --output mutations.json

For each fault, the file of tests that caught it in an earlier trial runs first, until a test fails,
then the tests of its package, those of the surface, and the other folders one by one. The JSON file
has a row for each fault, with the tests that passed; the same command resumes where it was stopped,
also within a fault. Files of the package at its end, as ``race/rules.py``, choose their faults.
"""

import argparse
import dataclasses
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
# Tests of the packages that have no folder of their name.
ELSEWHERE = {
    "studies": "tests/evaluation",
    "integrations": "tests/test_gym.py",
}


@dataclasses.dataclass(frozen=True)
class Fault:
    """One occurrence of ``old`` in a file of the package becomes ``new``."""

    file: str
    old: str
    new: str
    tests: str

    @property
    def name(self) -> str:
        """The file and what stands there."""
        return f"{self.file}: {self.old} -> {self.new}"

    def plant(self, package: Path) -> None:
        """Write the fault into a copy of the package."""
        path = package / self.file
        text = path.read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise SystemExit(f"{self.file}: {self.old!r} stands there {text.count(self.old)} times")
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")


FAULTS = [Fault(**row) for row in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())]


def copy_of(folder: Path) -> Path:
    """The repository's files in a folder."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def tests_of(fault: Fault) -> list[str]:
    """Files and folders of tests, in the order of their runs."""
    package = fault.file.split("/")[0]
    first = [fault.tests, ELSEWHERE.get(package, f"tests/{package}"), "tests/surface"]
    folders = sorted(path.parent.relative_to(ROOT) for path in ROOT.glob("tests/*/__init__.py"))
    files = sorted(path.relative_to(ROOT) for path in ROOT.glob("tests/test_*.py"))
    # The tests of the documentation compare hashes of sources, and the last one looks for faults.
    others = [path.as_posix() for path in (*folders, *files)]
    names = dict.fromkeys([*first, *others])
    return [x for x in names if x not in ("tests/docs", "tests/test_mutations.py")]


def failure_of(names: str, folder: Path, tier: str, workers: str) -> list[str]:
    """The first test that fails in a copy of the repository, if one does."""
    # Programs that a fault does not change are compiled once for all trials.
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache/jax"))
    environment = os.environ | {
        "PYTHONPATH": str(folder),
        "JAX_COMPILATION_CACHE_DIR": cache,
        "TEST_CPU_SECONDS": "60",  # a fault may take time, which is not what is counted
    }
    command = [sys.executable, "-m", "pytest", "-x", "-rfE", "-n", workers, "--no-header"]
    command += ["-p", "no:cacheprovider", names, *(("-m", "not slow") if tier == "fast" else ())]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    failed = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
    if not failed and done.returncode not in (0, 5):  # 5: no test was chosen
        raise SystemExit(f"{names}: pytest ended with {done.returncode}\n{done.stdout}")
    return failed[:1]


def trial(fault: Fault, tier: str, workers: str, passed: list[str]) -> Iterator[dict[str, object]]:
    """After each file or folder of tests: whether it catches the fault, and the first that does."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = copy_of(Path(name))
        fault.plant(folder / "quadjax")
        for names in tests_of(fault):
            if names in passed or not (folder / names).exists():
                continue
            failed = failure_of(names, folder, tier, workers)
            passed = passed if failed else [*passed, names]
            seconds = round(time.monotonic() - begin)
            yield {"caught": bool(failed), "by": failed, "seconds": seconds, "passed": passed}
            if failed:
                return


def main() -> None:
    """Run the faults that the file has no row of, and print the count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tier", choices=("fast", "all"), default="fast")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--workers", default="2", help="processes; 0: this one")
    parser.add_argument("files", nargs="*", help="of the package, whose faults are planted (all)")
    own = parser.parse_args()
    rows = json.loads(own.output.read_text()) if own.output.exists() else {}
    faults = [fault for fault in FAULTS if not own.files or fault.file in own.files]
    for fault in faults:
        row = rows.get(fault.name, {"caught": False, "passed": []})
        if row["caught"]:
            continue
        for result in trial(fault, own.tier, own.workers, row["passed"]):
            rows[fault.name] = result
            own.output.write_text(json.dumps(rows, indent=1) + "\n")
            print(fault.name, result["by"] or result["passed"][-1:], flush=True)
    caught = sum(bool(rows[fault.name]["caught"]) for fault in faults)
    print(f"{caught} of {len(faults)} faults are caught by the tests of the tier {own.tier}")


if __name__ == "__main__":
    main()
