"""Checks on an emulated processor: bits, instructions, stack, writable data."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadjax.export.verify.checks_bits import check_warnings
from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import (
    write_float,
    write_harness,
    write_memory,
    write_startup,
)
from quadjax.export.verify.harness import machine_infer
from quadjax.export.verify.result import Skipped, require
from quadjax.export.verify.toolchain import (
    FREESTANDING,
    Compiler,
    arm_none_eabi,
    armhf,
    bebop,
    has_module,
    need_program,
    zig_arm,
    zig_thumb,
)

if TYPE_CHECKING:
    from quadjax.export.verify.machine import Machine

SCALAR, NEON = 0, 1
LARGEST_STACK, WIDE = 2048, 120  # bytes, for networks of at most WIDE neurons per layer
CLAMPED = 4  # instructions that depend on whether a command is clamped
COUNTED = 12  # vectors whose instructions are counted


@dataclasses.dataclass(frozen=True)
class Build:
    """The C by one compiler for one processor, and the kernel that runs."""

    processor: str
    label: str
    make: Callable[[], Compiler]
    tag: str  # of the file
    kernel: int = SCALAR

    @property
    def name(self) -> str:
        """The name of its check."""
        return f"{self.processor} {self.label}"


def _cortex_m(processor: str) -> list[Build]:
    short = processor.removeprefix("Cortex-").lower()
    return [
        Build(processor, "zig", lambda: zig_thumb(processor), f"zig_{short}"),
        Build(processor, "gcc", lambda: arm_none_eabi(processor), f"gcc_{short}"),
    ]


BUILDS = (
    Build("Cortex-A9", "scalar, zig", lambda: zig_arm(neon=False), "zig_scalar"),
    Build("Cortex-A9", "NEON, zig", lambda: zig_arm(neon=True), "zig_neon", NEON),
    Build("Cortex-A9", "scalar, gcc", bebop, "bebop"),
    Build("Cortex-A9", "NEON, gcc", bebop, "bebop", NEON),
    *_cortex_m("Cortex-M7"),
    *_cortex_m("Cortex-M4"),
)


def need_emulator() -> None:
    """Raise ``Skipped`` without the packages of the emulator."""
    for module in ("unicorn", "elftools"):
        if not has_module(module):
            raise Skipped(f"no {module}; pip install 'quadjax[verify]'")


def flags_of(compiler: Compiler, entry: str) -> list[str]:
    """Of an executable without a C library; ``entry`` is a function of it."""
    return [f"-Wl,-e,{entry}", *(FREESTANDING if compiler.name != "zig cc" else [])]


def _executable(c: Context, build: Build, compiler: Compiler) -> Path:
    """The folder's C with the harness."""
    output = c.work / f"{build.tag}.elf"
    if output.is_file():
        return output
    folder = c.folder
    neon = [f"-D{folder.name.upper()}_WITH_NEON=1"] if build.processor == "Cortex-A9" else []
    extra = [*neon, f"-I{folder.path}", *flags_of(compiler, f"{folder.name}_forward")]
    sources = [*folder.files, write_harness(folder, c.work), write_memory(c.work)]
    return compiler.build(sources, output, extra)


def machine_of(elf: Path, build: Build) -> "Machine":
    """The emulated processor of a build, with its executable."""
    from quadjax.export.verify.machine import Machine  # needs packages of an extra

    return Machine(elf, build.processor)


def _count(c: Context, elf: Path, build: Build) -> tuple[int, int, int]:
    """Largest and smallest instructions, and stack, of one inference of any data.

    The C has no branch on data. A compiler may make a few, so they may differ by a thousandth, or
    by ``CLAMPED`` for each command of a small network: GCC clamps them by branches on the M7.
    """
    machine, kernel = machine_of(elf, build), build.kernel
    picked = [c.vectors[i] for i in np.linspace(0, c.count - 1, COUNTED).astype(int)]
    picked += [c.hostile[i] for i in np.linspace(0, len(c.hostile) - 1, COUNTED).astype(int)]
    counts, stack = set(), 0
    for vector in picked:
        machine.release()
        status, command = machine.reserve(8), machine.reserve(16)
        x = machine.place(vector)
        name = f"{c.folder.name}_forward_with"
        count, used = machine.count(name, status, kernel, x, command)
        counts.add(count)
        stack = max(stack, used)
    most, least = max(counts), min(counts)
    allowed = max(most // 1000, CLAMPED * c.folder.network.outputs)
    require(most - least <= allowed, f"{least} to {most} instructions, depending on the data")
    check_stack(c, stack)
    return most, least, stack


def check_stack(c: Context, stack: int) -> None:
    """Raise ``Failed`` for more stack than networks of ordinary widths may take."""
    widest = max(len(layer.bias) for layer in c.folder.network.layers)
    require(stack < LARGEST_STACK or widest > WIDE, f"{stack} bytes of stack")


def sizes_of(elf: Path) -> tuple[int, int]:
    """Bytes of read-only code and data, and of writable data."""
    from elftools.elf.elffile import ELFFile

    with open(elf, "rb") as stream:
        found = [s for s in ELFFile(stream).iter_sections() if s["sh_flags"] & 2]
        writable = sum(s["sh_size"] for s in found if s["sh_flags"] & 1)
        return sum(s["sh_size"] for s in found) - writable, writable


def _arm_check(c: Context, build: Build) -> str:
    need_emulator()
    elf = _executable(c, build, build.make())
    machine = machine_of(elf, build)
    mismatches = machine.call(f"{c.folder.name}_self_test_with", build.kernel)
    require(mismatches == 0, f"{mismatches} self-test mismatches")
    for name in ("race", "estimator", "battery"):
        if f"{c.folder.name}_{name}_self_test" in machine.symbols:
            mismatches = machine.call(f"{c.folder.name}_{name}_self_test")
            require(mismatches == 0, f"{mismatches} {name} self-test mismatches")
    c.same(build.tag, machine_infer(machine, build.kernel, c.vectors), c.expected)
    c.same(build.tag, machine_infer(machine, build.kernel, c.hostile), c.expected_hostile)
    _, writable = sizes_of(elf)
    require(writable == 0, f"{writable} bytes of writable data")
    most, least, stack = _count(c, elf, build)
    spread = f", at least {least:,}" if least < most else " whatever the data"
    return (
        f"{c.count} vectors the same; {most:,} instructions{spread}, {stack} B stack, "
        "no writable data"
    )


def arm_checks() -> dict[str, Callable[[Context], str]]:
    """A check of each build, by its name."""
    return {build.name: functools.partial(_arm_check, build=build) for build in BUILDS}


def float_instructions(c: Context, build: Build, compiler: Compiler) -> int:
    """Instructions of one inference of the float version."""
    sources = [write_float(c.folder, c.work), write_memory(c.work)]
    output = c.work / f"{build.tag}_{build.kernel}_float.elf"
    elf = compiler.build(sources, output, flags_of(compiler, "float_forward"))
    machine = machine_of(elf, build)
    x = machine.place(c.folder.rollouts.observations[0])
    return machine.count("float_forward", x, machine.reserve(16))[0]


def compilers_of(c: Context) -> list[tuple[Build, Compiler]]:
    """The builds for the target's processor whose compiler is found."""
    found = []
    for build in (b for b in BUILDS if b.processor == c.folder.target.processor):
        with contextlib.suppress(Skipped):
            found.append((build, build.make()))
    if not found:
        raise Skipped("no compiler for ARM; pip install 'quadjax[verify]'")
    return found


def check_against_float(c: Context) -> str:
    """Instructions, and those of float C with the same compiler and flags."""
    need_emulator()
    parts = []
    for build, compiler in compilers_of(c):
        single = float_instructions(c, build, compiler)
        fixed, _, _ = _count(c, _executable(c, build, compiler), build)
        parts.append(f"{build.label} {fixed:,} (float {single:,})")
    return "; ".join(parts)


def check_step(c: Context) -> str:
    """Instructions and stack of all that runs on board at each step, at most."""
    need_emulator()
    parts = []
    for build, compiler in compilers_of(c):
        race, more, stack = _count_step(c, _executable(c, build, compiler), build)
        check_stack(c, stack)
        added = "".join(f" + {name} {count:,}" for name, count in more.items())
        parts.append(f"{build.label} {race:,}{added}, {stack} B stack")
    return "; ".join(parts)


def check_memory(c: Context) -> str:
    """Flash of the exported files: tables, code and the vectors of the self-tests."""
    need_emulator()
    parts = {}
    for build, compiler in compilers_of(c):
        extra = [f"-I{c.folder.path}", *flags_of(compiler, f"{c.folder.name}_forward")]
        sources = [*c.folder.files, write_memory(c.work)]
        elf = compiler.build(sources, c.work / f"{build.tag}_sizes.elf", extra)
        parts[compiler.name] = "{:,} B flash, {} B writable data".format(*sizes_of(elf))
    return "; ".join(f"{name} {text}" for name, text in parts.items())


def _count_step(c: Context, elf: Path, build: Build) -> tuple[int, dict[str, int], int]:
    """Largest instructions of ``race_step`` and of the updates, and stack, of any data."""
    machine, prefix = machine_of(elf, build), c.folder.name
    rows = np.linspace(0, len(c.folder.rollouts.states) - 1, COUNTED).astype(int)
    hostile = np.linspace(0, len(c.hostile) - 1, COUNTED).astype(int)
    size = c.folder.race.state_size
    states = [*c.folder.rollouts.states[rows], *c.hostile[hostile, :size]]
    race, status, command = (machine.reserve(size) for size in (64, 16, 16))
    memory, moment, force = (machine.reserve(size) for size in (128, 16, 16))
    battery, calls = machine.reserve(128), {"race_step": (race, build.kernel)}
    ends = {"race_step": (command, 0), "estimator": (moment, force), "battery": (force,)}
    calls |= {"estimator": (memory,)} if c.folder.estimator is not None else {}
    calls |= {"battery": (battery,)} if c.folder.battery is not None else {}
    largest = np.zeros((len(calls), 2), int)
    for state in states:
        x = machine.place(state)
        used = [
            machine.count(_function(prefix, name), status, *first, x, *ends[name])
            for name, first in calls.items()
        ]
        largest = np.maximum(largest, used)
    counts = dict(zip(calls, largest[:, 0].tolist(), strict=True))
    return counts.pop("race_step"), counts, int(largest[:, 1].max())


def _function(prefix: str, name: str) -> str:
    """The C function of a part of a step."""
    return f"{prefix}_{name}" if name == "race_step" else f"{prefix}_{name}_update"


def _qemu(c: Context, make: Callable[[], Compiler], tag: str) -> str:
    folder, compiler, qemu = c.folder, make(), need_program("qemu-arm")
    extra = ["-DHARNESS_MAIN", f"-D{folder.name.upper()}_WITH_NEON=1", f"-I{folder.path}"]
    sources = [*folder.files, write_harness(folder, c.work)]
    program = compiler.build(sources, c.work / f"{tag}_main", extra)
    for kernel in "sn":
        count = c.run([qemu, "-cpu", "cortex-a9", str(program)], tag, kernel)
    return f"{count} vectors the same, kernels scalar and NEON"


# Paparazzi's flags and hard float, under QEMU's Cortex-A9.
check_qemu_armel = functools.partial(_qemu, make=bebop, tag="armel")
check_qemu_armhf = functools.partial(_qemu, make=armhf, tag="armhf")


BOARDS = {"Cortex-M7": "mps2-an500", "Cortex-M4": "mps2-an386"}
# The program's arguments go to it by semihosting, as do its files.
SEMIHOSTING = (
    'exec {qemu} -M {board} -nographic -monitor none -serial none -kernel "{program}" '
    '-semihosting-config enable=on,target=native,arg=m,arg="$1",arg="$2",arg="$3"'
)


def check_qemu_board(c: Context, processor: str) -> str:
    """The C on a board that QEMU emulates, with the C library of the cross compiler."""
    folder, compiler, qemu = c.folder, arm_none_eabi(processor), need_program("qemu-system-arm")
    extra = ["-DHARNESS_MAIN", "--specs=rdimon.specs", "-Wl,--section-start=.vectors=0"]
    sources = [*folder.files, write_harness(folder, c.work), write_startup(c.work)]
    output = c.work / f"{BOARDS[processor]}.elf"
    program = compiler.build(sources, output, [*extra, f"-I{folder.path}"])
    command = SEMIHOSTING.format(qemu=qemu, board=BOARDS[processor], program=program)
    count = c.run(["sh", "-c", command, "sh"], output.stem, "s")
    return f"{BOARDS[processor]}: {count} vectors the same"


def board_checks() -> dict[str, Callable[[Context], str]]:
    """A check of each board that QEMU emulates, by its name."""
    return {f"QEMU {p}": functools.partial(check_qemu_board, processor=p) for p in BOARDS}


def check_warnings_bebop(c: Context) -> str:
    """No warning from the cross compiler under Paparazzi's flags."""
    return check_warnings(c, bebop(), (f"-D{c.folder.name.upper()}_WITH_NEON=1",))
