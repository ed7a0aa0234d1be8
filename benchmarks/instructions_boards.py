"""Exported C on an emulated processor, for ``benchmarks.instructions``."""

from pathlib import Path

import numpy as np
from elftools.elf.elffile import ELFFile

from benchmarks.instructions_builds import WITH_MATH, Build
from benchmarks.instructions_machine import Machine
from quadjax.export.compiler import Compiler
from quadjax.export.conversion import Converted
from quadjax.export.library import EXACT, HOST, VEHICLE, write_c

HERE = Path(__file__).parent
FUNCTIONS = ("sinf", "cosf", "asinf", "logf", "floorf")
MATH = "".join(  # math.h where there is no C library
    (
        *(f"float {name}(float);\n" for name in FUNCTIONS),
        "float atan2f(float, float);\n",
        *(f"#define {name} __builtin_{name}\n" for name in ("fabsf", "sqrtf")),
    )
)


class Board:
    """The C of a policy on an emulated processor."""

    def __init__(self, of: Converted, processor: str, build: Build, work: Path) -> None:
        """Build and start it; ``Skipped`` without the compiler."""
        compiler, files = build.make(), [x for x in write_c(of, work) if x.parent != HOST]
        if not build.has_math:
            (work / "math.h").write_text(MATH)
        flags = [f"-I{work}", "-Wl,-e,bench_start", EXACT, *build.options]
        flags += WITH_MATH if build.has_math else []
        elf = work / "policy.elf"
        compiler.build([*files, HERE / "instructions.c"], elf, flags)
        every = [*files, HERE / "instructions.c"]  # the last one includes the policy's tables
        self.read_only = sum(_read_only(compiler, path, work) for path in every)
        self._machine, self._started = Machine(elf, processor), (int(build.neon), of.frequency)
        assert self._machine.call("bench_start", int(build.neon), round(of.frequency)) == 1

    def start(self) -> tuple[int, int]:
        """Instructions and bytes of stack of ``qj_pilot_start``, with its self-test."""
        neon, frequency = self._started
        return self._machine.count("bench_start", neon, round(frequency))

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Rows (n, 5) int32, commands and trace, of inputs (n, inputs) int32."""
        place, out = self._machine.place(np.int32(q)), self._machine.reserve(20 * len(q))
        self._machine.call("bench_forward", place, out, len(q))
        return self._machine.read(out, np.int32, (len(q), 5))

    def step(self, vehicle: np.ndarray) -> np.ndarray:
        """Commands (4,) float32 of a step in a state."""
        out = self._machine.reserve(64)
        self._machine.call("bench_step", self._machine.place(vehicle), out)
        return self._machine.read(out, np.float32, (4,))

    def count(self, name: str, row: np.ndarray) -> tuple[int, int]:
        """Instructions and bytes of stack of ``infer`` or ``step``, of one row."""
        place, out = self._machine.place(row), self._machine.reserve(64)
        return self._machine.count(f"bench_{name}", place, out)


def _read_only(compiler: Compiler, source: Path, work: Path) -> int:
    """Bytes of code and constants of a source, without those of the C library."""
    compiler.build([source], work / "one.o", [f"-I{work}", EXACT, "-c"])
    with open(work / "one.o", "rb") as stream:
        sections = [s for s in ELFFile(stream).iter_sections() if s["sh_flags"] & 2]
        return sum(s["sh_size"] for s in sections if not s["sh_flags"] & 1)


def sample_vehicle() -> np.ndarray:
    """A state of a drone in flight."""
    vehicle = np.zeros(1, VEHICLE)
    vehicle["position"], vehicle["velocity"] = [0.5, -0.7, -1.4], [4.0, 2.0, 0.3]
    vehicle["quaternion"] = [0.9, 0.3, -0.2, 0.24]
    vehicle["rates"], vehicle["rotor_speed"] = [0.4, -1.0, 0.6], 800.0
    vehicle["specific_force"], vehicle["thrust"] = [0.3, -0.2, -14.0], 14.0
    vehicle["body_velocity"] = [3.0, 2.0, -1.0]
    return vehicle
