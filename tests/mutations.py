"""Plant small faults in a copy of the repository, one at a time, and count those that tests catch.

    python -m tests.mutations --tier all --output mutations.json

For each fault, the tests of its package run first, until one fails, then those of the surface, then
all others of the tier. The JSON file has a row for each fault; the same command goes on where it
was stopped.
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


def tests_of(fault: Fault) -> list[list[str]]:
    """Arguments of pytest, in the order of their runs: the package, the surface, all."""
    package = fault.file.split("/")[0]
    own = ELSEWHERE.get(package, f"tests/{package}")
    # The tests of the documentation compare hashes of sources, and the last one looks for faults.
    others = (own, "tests/surface", "tests/docs", "tests/test_mutations.py")
    rest = [*(f"--ignore={name}" for name in others), "tests"]
    return [[own], ["tests/surface"], rest]


def trial(fault: Fault, tier: str, workers: str) -> dict[str, object]:
    """Whether the tests of a tier catch a fault, and the first that does."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = copy_of(Path(name))
        fault.plant(folder / "quadjax")
        # Programs that the fault does not change are compiled once for all trials.
        cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache/jax"))
        environment = os.environ | {
            "PYTHONPATH": name,
            "JAX_COMPILATION_CACHE_DIR": cache,
            "TEST_CPU_SECONDS": "60",  # a fault may take time, which is not what is counted
        }
        for arguments in tests_of(fault):
            command = [sys.executable, "-m", "pytest", "-x", "-rfE", "-n", workers, "--no-header"]
            command += ["-p", "no:cacheprovider", *arguments]
            if tier == "fast":
                command += ["-m", "not slow"]
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True
            )
            failed = [x for x in done.stdout.splitlines() if x.startswith(("FAILED", "ERROR"))]
            if failed:
                break
            if done.returncode not in (0, 5):  # 5: no test was chosen
                raise SystemExit(
                    f"{fault.name}: pytest ended with {done.returncode}\n{done.stdout}"
                )
    seconds = round(time.monotonic() - begin)
    return {"caught": bool(failed), "by": failed[:1], "seconds": seconds}


def main() -> None:
    """Run the faults that the file has no row of, and print the count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tier", choices=("fast", "all"), default="fast")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--workers", default="2", help="processes; 0: this one")
    own = parser.parse_args()
    rows = json.loads(own.output.read_text()) if own.output.exists() else {}
    for fault in FAULTS:
        if fault.name not in rows:
            rows[fault.name] = trial(fault, own.tier, own.workers)
            own.output.write_text(json.dumps(rows, indent=1) + "\n")
            print(fault.name, rows[fault.name], flush=True)
    caught = sum(bool(rows[fault.name]["caught"]) for fault in FAULTS)
    print(f"{caught} of {len(FAULTS)} faults are caught by the tests of the tier {own.tier}")


if __name__ == "__main__":
    main()
