"""Compiled C as a library of this process, or on the emulated processor."""

import ctypes
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadjax.export.verify.emitted import write_float, write_harness, write_memory
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.toolchain import Compiler

if TYPE_CHECKING:
    from quadjax.export.verify.machine import Machine  # needs packages of an extra

ROW = 7  # commands, trace, clipped, NaN
CHUNK = 20_000  # vectors that go into the emulated machine at a time


@dataclasses.dataclass
class HostLibrary:
    """The C as a shared library of this process."""

    library: ctypes.CDLL
    folder: Folder

    def _call(self, name: str, *arguments: np.ndarray | int) -> int:
        values = [
            a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else ctypes.c_uint32(a)
            for a in arguments
        ]
        function = getattr(self.library, name)
        function.restype = ctypes.c_uint32
        return int(function(*values))

    def _rows(
        self, name: str, columns: int, kind: type, x: np.ndarray, *between: np.ndarray | int
    ) -> np.ndarray:
        """Rows (n, columns) of a harness function of floats ``x`` (n, ..)."""
        x = np.ascontiguousarray(x, np.float32)
        out = np.zeros((len(x), columns), kind)
        self._call(f"harness_{name}", x, *between, out, len(x))
        return out

    def infer(self, x: np.ndarray, kernel: int = 0) -> np.ndarray:
        """Rows (n, 7) int32 of observations (n, inputs)."""
        return self._rows("infer", ROW, np.int32, x, kernel)

    def command(self, x: np.ndarray) -> np.ndarray:
        """Commands (n, 4) of the forward function."""
        return self._rows("command", 4, np.uint16 if self.folder.network.rpm else np.float32, x, 0)

    def observe(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 of states and targets."""
        columns = self.folder.network.inputs + 3
        goals = np.ascontiguousarray(targets, np.uint32)
        return self._rows("observe", columns, np.int32, states, goals)

    def events(self, positions: np.ndarray, target: int) -> np.ndarray:
        """Rows (n, 2): event and target along positions (n, 3)."""
        return self._rows("events", 2, np.uint32, positions, target)

    def estimate(self, measurements: np.ndarray) -> np.ndarray:
        """Moments and forces (n, 6) along measurements (n, 13)."""
        return self._rows("estimate", 6, np.float32, measurements)

    def highest_rpm(self, samples: np.ndarray) -> np.ndarray:
        """Estimates (n,) of the highest speed, rpm, along samples (n, 8)."""
        return self._rows("battery", 1, np.float32, samples)[:, 0]

    def self_test(self) -> int:
        """Mismatches of the network's self-test."""
        return self._call(f"{self.folder.name}_self_test")


def load_library(
    compiler: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
) -> ctypes.CDLL:
    """Build C that needs no C library for this machine, and load it."""
    options, sources = ["-shared", "-fPIC", *extra], list(sources)
    if compiler.name == "zig cc" and sys.platform == "linux":
        # Otherwise it would first build parts of a C library, which takes it seconds.
        options.append("-nostdlib")
        sources.append(write_memory(output.parent))
    return ctypes.CDLL(str(compiler.build(sources, output, options)))


def host_library(folder: Folder, compiler: Compiler, work: Path) -> HostLibrary:
    """Build the folder's C for this machine and load it."""
    sources = [*folder.files, write_harness(folder, work)]
    library = load_library(compiler, sources, work / "host.so", [f"-I{folder.path}"])
    return HostLibrary(library, folder)


def float_library(folder: Folder, compiler: Compiler, work: Path) -> ctypes.CDLL:
    """The float version for this machine, without fused or reordered arithmetic."""
    source = write_float(folder, work)
    return load_library(compiler, [source], work / "float.so", ["-ffp-contract=off"])


def float_commands(library: ctypes.CDLL, x: np.ndarray) -> np.ndarray:
    """Commands (n, 4) float32 of the float version."""
    x = np.ascontiguousarray(x, np.float32)
    out = np.zeros((len(x), 4), np.float32)
    pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (x, out))
    library.float_batch(*pointers, len(x))
    return out


def machine_infer(machine: "Machine", kernel: int, x: np.ndarray) -> np.ndarray:
    """Rows (n, 7) int32 of observations (n, inputs), on the emulated processor."""
    rows = []
    for start in range(0, len(x), CHUNK):
        part = np.ascontiguousarray(x[start : start + CHUNK], np.float32)
        machine.release()
        source = machine.place(part)
        target = machine.reserve(len(part) * ROW * 4)
        machine.call("harness_infer", source, kernel, target, len(part))
        rows.append(machine.read(target, np.int32, (len(part), ROW)))
    return np.concatenate(rows)
