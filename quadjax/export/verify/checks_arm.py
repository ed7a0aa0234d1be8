"""Checks on an emulated Cortex-A9: bits, instructions, stack, writable data."""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadjax.export.verify.checks_bits import check_warnings
from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import write_float, write_harness, write_memory
from quadjax.export.verify.harness import machine_infer
from quadjax.export.verify.result import Skipped, require
from quadjax.export.verify.toolchain import (
    FREESTANDING,
    Compiler,
    armhf,
    bebop,
    has_module,
    need_program,
    zig_arm,
)

SCALAR, NEON = 0, 1
LARGEST_STACK, WIDE = 2048, 120  # bytes, for networks of at most WIDE neurons per layer
COUNTED = 12  # vectors whose instructions are counted


def _need_emulator() -> None:
    for module in ("unicorn", "elftools"):
        if not has_module(module):
            raise Skipped(f"no {module}; pip install 'quadjax[verify]'")


def _build(c: Context, compiler: Compiler, tag: str) -> Path:
    output = c.work / f"{tag}.elf"
    if output.is_file():
        return output
    folder = c.folder
    with_neon = f"-D{folder.name.upper()}_WITH_NEON=1"
    extra = [with_neon, f"-I{folder.path}", f"-Wl,-e,{folder.name}_forward"]
    extra += FREESTANDING if compiler.name != "zig cc" else []
    sources = [*folder.files, write_harness(folder, c.work), write_memory(c.work)]
    return compiler.build(sources, output, extra)


def _count(c: Context, elf: Path, kernel: int) -> tuple[int, int]:
    """Instructions and stack of one inference, the same for ordinary and hostile data."""
    from quadjax.export.verify.machine import Machine

    machine = Machine(elf)
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
    require(len(counts) == 1, f"instructions depend on the data: {min(counts)} to {max(counts)}")
    _check_stack(c, stack)
    return counts.pop(), stack


def _check_stack(c: Context, stack: int) -> None:
    widest = max(len(layer.bias) for layer in c.folder.network.layers)
    require(stack < LARGEST_STACK or widest > WIDE, f"{stack} bytes of stack")


def _writable(elf: Path, work: Path) -> int:
    """Bytes of writable data that the policy's own files bring."""
    from elftools.elf.elffile import ELFFile

    with open(elf, "rb") as stream:
        sections = ELFFile(stream).iter_sections()
        return sum(s["sh_size"] for s in sections if s["sh_flags"] & 1 and s["sh_flags"] & 2)


def _arm_check(c: Context, compiler: Compiler, tag: str, kernel: int) -> str:
    from quadjax.export.verify.machine import Machine

    _need_emulator()
    elf = _build(c, compiler, tag)
    machine = Machine(elf)
    mismatches = machine.call(f"{c.folder.name}_self_test_with", kernel)
    require(mismatches == 0, f"{mismatches} self-test mismatches")
    for name in ("race", "estimator"):
        if f"{c.folder.name}_{name}_self_test" in machine.symbols:
            mismatches = machine.call(f"{c.folder.name}_{name}_self_test")
            require(mismatches == 0, f"{mismatches} {name} self-test mismatches")
    c.same(tag, machine_infer(machine, kernel, c.vectors), c.expected)
    c.same(tag, machine_infer(machine, kernel, c.hostile), c.expected_hostile)
    writable = _writable(elf, c.work)
    require(writable == 0, f"{writable} bytes of writable data")
    count, stack = _count(c, elf, kernel)
    return (
        f"{c.count} vectors the same; {count:,} instructions whatever the data, "
        f"{stack} B stack, no writable data"
    )


# Name of the check, compiler, tag of its build, and kernel.
BUILDS: tuple[tuple[str, Callable[[], Compiler], str, int], ...] = (
    ("Cortex-A9 scalar, zig", lambda: zig_arm(neon=False), "zig_scalar", SCALAR),
    ("Cortex-A9 NEON, zig", lambda: zig_arm(neon=True), "zig_neon", NEON),
    ("Cortex-A9 scalar, gcc", bebop, "bebop", SCALAR),
    ("Cortex-A9 NEON, gcc", bebop, "bebop", NEON),
)


def arm_checks() -> dict[str, Callable[[Context], str]]:
    """A check of each kernel by each compiler: zig, and GCC with Paparazzi's flags."""

    def check(c: Context, make: Callable[[], Compiler], tag: str, kernel: int) -> str:
        return _arm_check(c, make(), tag, kernel)

    return {
        name: functools.partial(check, make=make, tag=tag, kernel=kernel)
        for name, make, tag, kernel in BUILDS
    }


def float_instructions(c: Context, compiler: Compiler, tag: str) -> int:
    """Instructions of one inference of the float version."""
    from quadjax.export.verify.machine import Machine

    extra = ["-Wl,-e,float_forward"] + (FREESTANDING if compiler.name != "zig cc" else [])
    elf = compiler.build([write_float(c.folder, c.work), write_memory(c.work)], c.work / tag, extra)
    machine = Machine(elf)
    x = machine.place(c.folder.rollouts.observations[0])
    return machine.count("float_forward", x, machine.reserve(16))[0]


def _compilers() -> list[tuple[str, Compiler, str, int]]:
    """The builds whose compiler is found."""
    found = []
    for name, make, tag, kernel in BUILDS:
        with contextlib.suppress(Skipped):
            found.append((name.removeprefix("Cortex-A9 "), make(), tag, kernel))
    if not found:
        raise Skipped("no compiler for ARM; pip install 'quadjax[verify]'")
    return found


def check_against_float(c: Context) -> str:
    """Instructions, and those of float C with the same compiler and flags."""
    _need_emulator()
    parts = []
    for name, compiler, tag, kernel in _compilers():
        single = float_instructions(c, compiler, f"{tag}_{kernel}_float.elf")
        fixed, _ = _count(c, _build(c, compiler, tag), kernel)
        parts.append(f"{name} {fixed:,} (float {single:,})")
    return "; ".join(parts)


def check_step(c: Context) -> str:
    """Instructions and stack of all that runs on board at each step, at most."""
    _need_emulator()
    parts = []
    for name, compiler, tag, kernel in _compilers():
        race, estimator, stack = _count_step(c, _build(c, compiler, tag), kernel)
        _check_stack(c, stack)
        more = f" + estimator {estimator:,}" if estimator else ""
        parts.append(f"{name} {race:,}{more}, {stack} B stack")
    return "; ".join(parts)


def _count_step(c: Context, elf: Path, kernel: int) -> tuple[int, int, int]:
    """Largest instructions of ``race_step`` and ``estimator_update``, and stack, of any data."""
    from quadjax.export.verify.machine import Machine

    machine, prefix = Machine(elf), c.folder.name
    rows = np.linspace(0, len(c.folder.rollouts.states) - 1, COUNTED).astype(int)
    hostile = np.linspace(0, len(c.hostile) - 1, COUNTED).astype(int)
    size = c.folder.race.state_size
    states = [*c.folder.rollouts.states[rows], *c.hostile[hostile, :size]]
    race, status, command = (machine.reserve(size) for size in (64, 16, 16))
    memory, moment, force = (machine.reserve(size) for size in (128, 16, 16))
    largest = np.zeros((2, 2), int)
    for state in states:
        x = machine.place(state)
        used = [machine.count(f"{prefix}_race_step", status, race, kernel, x, command, 0), (0, 0)]
        if c.folder.estimator is not None:
            update = f"{prefix}_estimator_update"
            used[1] = machine.count(update, status, memory, x, moment, force)
        largest = np.maximum(largest, used)
    return int(largest[0, 0]), int(largest[1, 0]), int(largest[:, 1].max())


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


def check_warnings_bebop(c: Context) -> str:
    """No warning from the cross compiler under Paparazzi's flags."""
    return check_warnings(c, bebop(), (f"-D{c.folder.name.upper()}_WITH_NEON=1",))
