"""Common data of the checks: the folder, the vectors and the emulator's results."""

import dataclasses
import functools
import subprocess
from pathlib import Path

import numpy as np

from quadjax.export import emulator, flights
from quadjax.export.qjp.autopilots import RUNTIMES
from quadjax.export.targets import AS_FILE
from quadjax.export.vectors import check_vectors, hostile_vectors
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.harness import HostLibrary, host_library
from quadjax.export.verify.loader import LoaderLibrary, QjpContext
from quadjax.export.verify.result import Failed
from quadjax.export.verify.toolchain import host
from quadjax.race.laps import Trace

TRACED_RUNS, TRACED_LAPS = 4, 3
BATCH = 50_000  # vectors that NumPy takes at a time


def expected_rows(folder: Folder, x: np.ndarray) -> np.ndarray:
    """Rows (n, 7) int32, as the harness gives them, by the NumPy emulator."""
    rows = []
    for start in range(0, len(x), BATCH):
        part = x[start : start + BATCH]
        q, clipped, nan = emulator.quantize(folder.network, part)
        command, trace = emulator.forward_traced(folder.network, q)
        digest = emulator.trace_digest(trace)
        columns = [digest, clipped, nan]
        words = np.stack([c.astype(np.uint32).view(np.int32) for c in columns], axis=1)
        rows.append(np.concatenate([command, words], axis=1))
    return np.concatenate(rows)


@dataclasses.dataclass
class Context:
    """One verification."""

    folder: Folder
    work: Path  # a temporary folder for what is built
    count: int  # vectors
    runs: int = 0  # of the closed loop
    allow_unfinished: bool = False  # accept a policy that does not finish its own race
    allow_other_race: bool = False  # accept C code for another race than the policy's
    mutations: int = 2_000  # of a .qjp file

    @functools.cached_property
    def vectors(self) -> np.ndarray:
        """Corner, trajectory, uniform and Gaussian vectors, float32."""
        return check_vectors(self.folder.network, self.count, self.folder.rollouts.observations)

    @functools.cached_property
    def hostile(self) -> np.ndarray:
        """NaN, infinity, huge and subnormal numbers in every position, float32."""
        return hostile_vectors(self.folder.network)

    @functools.cached_property
    def expected(self) -> np.ndarray:
        """The emulator's rows of the vectors."""
        return expected_rows(self.folder, self.vectors)

    @functools.cached_property
    def expected_hostile(self) -> np.ndarray:
        """The emulator's rows of the hostile vectors."""
        return expected_rows(self.folder, self.hostile)

    @functools.cached_property
    def library(self) -> HostLibrary:
        """The generated C on this machine."""
        return host_library(self.folder, host(), self.work)

    @functools.cached_property
    def loader(self) -> QjpContext:
        """The ``.qjp`` file, and the C that flies it in the target's autopilot."""
        folder, runtime = self.folder, RUNTIMES[self.folder.target.autopilot or ""]
        files = {k: v for k, v in folder.expected.items() if k.startswith(f"{runtime.folder}/")}
        counts = (self.count, self.mutations, (folder.target.processor,))
        data = folder.binaries()[f"{folder.name}.qjp"]
        return QjpContext.make(data, self.work / "qjp", *counts, runtime, files)

    @property
    def flying(self) -> HostLibrary | LoaderLibrary:
        """On this machine, the C that flies."""
        return self.loader.library if self.folder.target.autopilot in AS_FILE else self.library

    @functools.cached_property
    def trace(self) -> Trace:
        """A few flights of the float policy, step by step."""
        return flights.fly_traced(self.folder.own, TRACED_RUNS, TRACED_LAPS)

    def run(self, command: list[str], who: str, kernel: str, most: int | None = None) -> int:
        """Run a build of the harness on at most ``most`` vectors and the hostile ones.

        Returns:
            The number of vectors.

        Raises:
            Failed: another exit status than 0, or other rows than the emulator's.
        """
        given, written = self.work / "vectors.bin", self.work / "rows.bin"
        pick = np.linspace(0, self.count - 1, min(self.count, most or self.count)).astype(int)
        np.concatenate([self.vectors[pick], self.hostile]).tofile(given)
        arguments = [*command, str(given), str(written), kernel]
        done = subprocess.run(arguments, capture_output=True, text=True)
        if done.returncode:
            raise Failed(f"exit status {done.returncode} {done.stderr.strip()[:300]}")
        rows = np.fromfile(written, np.int32).reshape(-1, 7)
        self.same(who, rows, np.concatenate([self.expected[pick], self.expected_hostile]))
        return len(rows)

    def same(self, who: str, rows: np.ndarray, expected: np.ndarray) -> None:
        """Raise ``Failed`` unless rows are the emulator's, bit for bit."""
        wrong = np.flatnonzero(np.any(rows != expected, axis=1))
        if wrong.size:
            raise Failed(f"{who}: {wrong.size} of {len(rows)} vectors differ, first {wrong[0]}")
