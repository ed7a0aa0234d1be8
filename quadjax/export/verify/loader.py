"""A ``.qjp`` file and the C that flies it: the runtime of one target, compiled for the checks."""

import ctypes
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from quadjax.core.files import write_bytes, write_text
from quadjax.export import emulator
from quadjax.export.integers import quantize
from quadjax.export.qjp.autopilots import RUNTIMES, Runtime, words_header
from quadjax.export.qjp.emit import emit_loader, qjp_source
from quadjax.export.qjp.policy import OUTPUTS, QjpPolicy
from quadjax.export.qjp.read import parse_qjp
from quadjax.export.targets import QJP
from quadjax.export.vectors import check_vectors, hostile_vectors
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.result import require
from quadjax.export.verify.toolchain import host

MOST_STATES = 20_000


@dataclasses.dataclass
class QjpContext:
    """A ``.qjp`` file, the C that flies it, and the folder in which the C is built."""

    data: bytes
    policy: QjpPolicy
    work: Path
    count: int  # states and inputs on which all must agree
    mutations: int
    processors: tuple[str, ...]
    runtime: Runtime

    @classmethod
    def make(
        cls,
        data: bytes,
        work: Path,
        count: int,
        mutations: int,
        processors: Sequence[str],
        runtime: Runtime = RUNTIMES[QJP],
        files: Mapping[str, str] | None = None,
    ) -> "QjpContext":
        """Read the file and write the C.

        Args:
            data: of the file.
            work: a folder for what is built.
            count: states and inputs on which all must agree.
            mutations: mutated files.
            processors: on which the C is emulated.
            runtime: the C that flies the file.
            files: its texts, by path in the export; those of the loader if not given.
        """
        for path, text in (emit_loader() if files is None else files).items():
            write_text(work / path, text)
        for file in ("harness.c", "fuzz.c"):
            write_text(work / runtime.folder / file, qjp_source(file))
        write_bytes(work / "policy.qjp", data)
        write_text(work / runtime.folder / "qjp_data.h", words_header("policy", data))
        return cls(data, parse_qjp(data), work, count, mutations, tuple(processors), runtime)

    @property
    def folder(self) -> Path:
        """The folder of the C."""
        return self.work / self.runtime.folder

    @property
    def sources(self) -> list[Path]:
        """The C files that fly."""
        return [self.work / path for path in self.runtime.files]

    @property
    def harness(self) -> list[Path]:
        """The C files that fly, and their harness."""
        return [*self.sources, self.folder / "harness.c"]

    @functools.cached_property
    def words(self) -> np.ndarray:
        """The file as the loader takes it."""
        return np.frombuffer(self.data, np.int32).copy()

    @functools.cached_property
    def inputs(self) -> np.ndarray:
        """Inputs of the network, (n, inputs) int32: ordinary ones, hostile ones, any integers."""
        network = self.policy.network
        x = np.concatenate([check_vectors(network, self.count, None), hostile_vectors(network)])
        q = quantize(x, network.box.exponents).astype(np.int32)
        any_bits = np.random.default_rng(5).integers(-(2**31), 2**31, (100, network.inputs))
        return np.concatenate([q, any_bits.astype(np.int32)])

    @functools.cached_property
    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """States (n, state_size) float32, half of them of any bits, and target gates (n,)."""
        rng, race = np.random.default_rng(6), self.policy.race
        count = min(self.count, MOST_STATES)
        ranges = np.ldexp(1.0, np.asarray(race.exponents))
        states = rng.uniform(-1.2, 1.2, (count, race.state_size)) * ranges
        states = states.astype(np.float32)
        bits = rng.integers(0, 2**32, (count // 2, race.state_size), dtype=np.uint32)
        states[: count // 2] = bits.view(np.float32)
        return states, rng.integers(0, race.gates, count)

    @functools.cached_property
    def library(self) -> "LoaderLibrary":
        """The C on this machine, with the file loaded."""
        extra = list(self.runtime.options)
        library = load_library(host(), self.harness, self.work / "loader.so", extra)
        error = library.harness_load(pointer(self.words), len(self.data))
        require(error == 0, f"the loader rejects the file: error {error}")
        return LoaderLibrary(library, self.policy)


@dataclasses.dataclass
class LoaderLibrary:
    """The loader as a shared library of this process."""

    library: ctypes.CDLL
    policy: QjpPolicy

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Rows (n, 5) int32, commands and trace, of inputs (n, inputs) int32."""
        q = np.ascontiguousarray(q, np.int32)
        rows = np.zeros((len(q), OUTPUTS + 1), np.int32)
        self.library.harness_forward(pointer(q), pointer(rows), len(rows))
        return rows

    def infer(self, x: np.ndarray) -> np.ndarray:
        """Rows as of ``forward`` of observations (n, inputs), quantized by NumPy."""
        return self.forward(emulator.quantize(self.policy.network, x)[0])

    def observe(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 of states and targets."""
        states = np.ascontiguousarray(states, np.float32)
        goals = np.ascontiguousarray(targets, np.uint32)
        rows = np.zeros((len(states), self.policy.network.inputs + 3), np.int32)
        self.library.harness_observe(pointer(states), pointer(goals), pointer(rows), len(rows))
        return rows

    def events(self, positions: np.ndarray, target: int) -> np.ndarray:
        """Rows (n, 2): event and target along positions (n, 3)."""
        positions = np.ascontiguousarray(positions, np.float32)
        rows = np.zeros((len(positions), 2), np.uint32)
        self.library.harness_events(pointer(positions), target, pointer(rows), len(rows))
        return rows


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """The address of an array's first number."""
    return array.ctypes.data_as(ctypes.c_void_p)
