"""Exported C on an emulated processor, for ``benchmarks.instructions``."""

from pathlib import Path

import numpy as np
from elftools.elf.elffile import ELFFile

from benchmarks.instructions_builds import FREESTANDING, Build
from benchmarks.instructions_machine import Machine
from quadjax.export.verify.build import HOST, VEHICLE, Sources
from quadjax.export.verify.result import require
from quadjax.export.words import FixedPolicy

HERE = Path(__file__).parent


class Board:
    """The C on an emulated processor, with a policy loaded."""

    def __init__(self, sources: Sources, build: Build, words: bytes, work: Path) -> None:
        """Build it and load the words; ``Skipped`` without the compiler, ``Failed`` if refused."""
        compiler = build.make()
        flags = ["-Wl,-e,harness_load", *sources.options, *build.options]
        flags += [] if compiler.name == "zig cc" else FREESTANDING
        files = [*sources.flying, HOST / "harness.c", HOST / "memory.c", HERE / "instructions.c"]
        name = f"{sources.target.name}_{build.label}".replace(", ", "_")
        elf = compiler.build(files, work / f"{name}.elf", flags)
        with open(elf, "rb") as stream:
            sections = [s for s in ELFFile(stream).iter_sections() if s["sh_flags"] & 2]
            self.read_only = sum(s["sh_size"] for s in sections if not s["sh_flags"] & 1)
        self._machine = machine = Machine(elf, sources.target.name)
        self._words = machine.place(np.frombuffer(words, np.int32)), len(words)
        self._pilot = machine.reserve(machine.call("harness_size"))
        wrong = machine.call("harness_load", self._pilot, *self._words)
        wrong = wrong or machine.call("bench_kernel", self._pilot, build.neon)
        require(wrong == 0, f"{build.label}: the loader or the pilot rejects the words: {wrong}")

    def loading(self) -> tuple[int, int]:
        """Instructions and bytes of stack of ``qj_load``."""
        return self._machine.count("qj_load", self._machine.reserve(4096), *self._words)

    def rows(self, name: str, columns: int, count: int, *parts: np.ndarray) -> np.ndarray:
        """Rows (count, columns) int32 of a function of the harness."""
        out = self._machine.reserve(4 * columns * count)
        places = [self._machine.place(part) for part in parts]
        self._machine.call(f"harness_{name}", self._pilot, *places, out, count)
        return self._machine.read(out, np.int32, (count, columns))

    def count(self, name: str, row: np.ndarray) -> tuple[int, int]:
        """Instructions and bytes of stack of ``infer`` or ``step``, of one row."""
        place, out = self._machine.place(row), self._machine.reserve(64)
        return self._machine.count(f"bench_{name}", self._pilot, place, out)


def vehicles(policy: FixedPolicy, states: np.ndarray) -> np.ndarray:
    """States (n, state_size) as ``qj_vehicle``; zeros for what the policy lacks."""
    rows = np.zeros(len(states), VEHICLE)
    for name, start in policy.race.starts.items():
        if name in VEHICLE.names:
            rows[name] = states[:, start : start + len(policy.race.fields[name])]
    return rows
