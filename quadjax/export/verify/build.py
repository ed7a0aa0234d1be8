"""The C of an export with its harness, compiled for this machine."""

import ctypes
import dataclasses
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.core.files import write_bytes
from quadjax.export.render import sizes_header, words_table
from quadjax.export.targets import RUNTIME, SENSORS, STATE_FIELDS, Target, runtime_files
from quadjax.export.verify.result import require
from quadjax.export.verify.toolchain import Compiler, host
from quadjax.export.words import COMMANDS, FixedPolicy, pack
from quadjax.race.observations import DISTURBANCES

HOST = RUNTIME / "host"
SYSTEM = ("stdbool.h", "stdint.h", "math.h")
VEHICLE = np.dtype(  # qj_vehicle
    [("time_us", "<u4")]
    + [(name, "<f4", size) for name, size in (
        ("position", 3), ("velocity", 3), ("euler", 3), ("quaternion", 4), ("rates", 3),
        ("rotor_speed", 4), ("rpm", 4), ("thrust", 1), ("moment_ext", 3), ("force_ext", 3),
        ("gyro", 3), ("specific_force", 3), ("body_velocity", 3), ("others_command", 4),
    )]
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Sources:
    """The C that a target flies, in a folder, and how it is compiled."""

    target: Target
    folder: Path  # a copy of the C, as the converter writes it
    call_ns: int  # between two calls of the pilot, or of the glue

    @classmethod
    def write(
        cls, target: Target, files: dict[str, bytes] | None, work: Path, policy: FixedPolicy
    ) -> "Sources":
        """Write the C; without ``files`` the runtime with its largest sizes, and no glue.

        The pilot is called at the rate of the estimators; without them at the autopilot's, or once
        a step.
        """
        if files is None:
            texts = {name: text.encode() for name, text in runtime_files(target).items()}
            sizes = sizes_header(policy, any_policy=True).encode()
            files = texts | {f"{target.folder}/qj_sizes.h": sizes}
        table = words_table("quadjax_words", pack(policy)).encode()
        for name, data in {**files, "stand_in/quadjax_words.h": table}.items():
            write_bytes(work / name, data)
        estimator = policy.battery or policy.estimator
        if estimator is not None:
            return cls(target, work, estimator.period_ns)
        return cls(target, work, round(1e9 / (target.calls or 1.0 / policy.race.time_step)))

    @property
    def include(self) -> Path:
        """The folder of the headers."""
        return self.folder / self.target.folder

    @property
    def flying(self) -> list[Path]:
        """The C of the runtime, without that of angles, which only glue uses."""
        return [path for path in sorted(self.include.glob("qj_*.c")) if path.name != "qj_angles.c"]

    @property
    def options(self) -> list[str]:
        """Compiler options: what the autopilot measures and takes, for targets without glue."""
        names = {*self.target.gives, *DISTURBANCES}
        values = {
            "GIVES": sum(
                1 << (16 if name == SENSORS else 1 + STATE_FIELDS.index(name)) for name in names
            ),
            "KINDS": sum(1 << kind for kind in self.target.kinds),
            "CALL_NS": self.call_ns,
        }
        return [f"-I{self.include}", *(f"-DINTERFACE_{k}={v}U" for k, v in values.items())]

    def autopilot(self) -> tuple[list[Path], list[str]]:
        """The C of the glue in a stand-in for its firmware, and its options.

        Headers of the firmware are empty: the stand-in has what they declare. Without glue, the
        stand-in calls the pilot.
        """
        target, headers = self.target, self.folder / "stand_in"
        firmware = HOST / f"{target.glue or 'pilot'}.c"
        files = [firmware, *self.flying, self.include / "qj_angles.c"]
        if target.glue == "indiflight":  # its build has two files, one of which is the glue
            files = [firmware, self.include / "neural_network.c"]
        for path in self.include.glob("*.[ch]"):
            for name in re.findall(r"#include [<\"](.+)[>\"]", path.read_text("utf-8")):
                if name not in SYSTEM and not (self.include / name).exists():
                    exists = (self.include / Path(name).name).exists()
                    text = f"#include <{Path(name).name}>\n" if exists else ""
                    write_bytes(headers / name, text.encode())
        return files, [f"-I{headers}", f"-I{HOST}", *self.options]


def load_library(
    compiler: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
) -> ctypes.CDLL:
    """Build C that needs no C library for this machine, and load it."""
    options, sources = ["-shared", "-fPIC", *extra], list(sources)
    if compiler.name == "zig cc" and sys.platform == "linux":
        # Otherwise it would first build parts of a C library, which takes it seconds.
        options.append("-nostdlib")
        sources.append(HOST / "memory.c")
    return ctypes.CDLL(str(compiler.build(sources, output, options)))


class Library:
    """The C on this machine, with a policy loaded."""

    def __init__(self, sources: Sources, policy: FixedPolicy, words: bytes, work: Path) -> None:
        """Build it and load the words.

        Raises:
            Failed: the loader or the pilot rejects them.
        """
        self._policy, self._words = policy, np.frombuffer(words, np.int32).copy()
        files = [*sources.flying, HOST / "harness.c"]
        library = load_library(host(), files, work / "host.so", sources.options)
        self._library = library
        self._pilot = np.zeros(library.harness_size() // 8 + 1, np.int64)
        error = library.harness_load(*pointers(self._pilot, self._words), len(words))
        require(error == 0, f"the loader or the pilot rejects the words: error {error}")

    def _rows(
        self, name: str, columns: int, kind: type, x: np.ndarray, *between: np.ndarray | int
    ) -> np.ndarray:
        out: np.ndarray = np.zeros((len(x), columns), kind)
        values = [v.ctypes.data_as(ctypes.c_void_p) if isinstance(v, np.ndarray) else v
                  for v in (self._pilot, np.ascontiguousarray(x), *between, out)]  # fmt: skip
        getattr(self._library, f"harness_{name}")(*values, len(x))
        return out

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Rows (n, 5) int32, commands and trace, of inputs (n, inputs) int32."""
        return self._rows("forward", COMMANDS + 1, np.int32, q.astype(np.int32))

    def sample(self, q: np.ndarray, counter: int) -> np.ndarray:
        """Sampled commands (n, 4) int32 of inputs (n, inputs) int32, from a counter on."""
        return self._rows("sample", COMMANDS, np.int32, q.astype(np.int32), counter)

    def observe(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 of the states of one flight and their targets."""
        columns, goals = self._policy.network.inputs + 3, targets.astype(np.uint32)
        return self._rows("observe", columns, np.int32, states.astype(np.float32), goals)

    def events(self, positions: np.ndarray, target: int) -> np.ndarray:
        """Rows (n, 2): event and target along positions (n, 3)."""
        return self._rows("events", 2, np.uint32, positions.astype(np.float32), target)

    def estimate(self, measurements: np.ndarray) -> np.ndarray:
        """Moments and forces (n, 6) along measurements (n, 13)."""
        return self._rows("estimate", 6, np.float32, measurements.astype(np.float32))

    def highest_rpm(self, samples: np.ndarray) -> np.ndarray:
        """Estimates (n,) of the highest speed, rpm, along samples (n, 8)."""
        return self._rows("battery", 1, np.float32, samples.astype(np.float32))[:, 0]


def pointers(*arrays: np.ndarray) -> list[ctypes.c_void_p]:
    """The addresses of arrays, as arguments of C."""
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
