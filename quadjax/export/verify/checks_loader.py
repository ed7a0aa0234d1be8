"""Checks of what a loaded policy costs on board, and proofs of the C that loads and flies it."""

from pathlib import Path

import numpy as np

from quadjax.core.files import write_text
from quadjax.export.qjp.autopilots import words_header
from quadjax.export.qjp.policy import table_start
from quadjax.export.render import render
from quadjax.export.verify.checks_arm import (
    COUNTED,
    Build,
    check_stack,
    compilers_of,
    flags_of,
    float_instructions,
    machine_of,
    need_emulator,
    sizes_of,
)
from quadjax.export.verify.checks_static import cppcheck, eva, proven
from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import write_memory
from quadjax.export.verify.result import require
from quadjax.export.verify.toolchain import Compiler, need_program

LARGEST_STRUCT = 4096  # bytes, more than a policy or a pilot needs
ROTORS = ("rotor_speed", 4)
VEHICLE = (("position", 3), ("velocity", 3), ("euler", 3), ("quaternion", 4), ("rates", 3), ROTORS)


def _vehicles(c: Context, states: np.ndarray) -> np.ndarray:
    """States as ``qjp_vehicle``, (n, 20) float32; zeros for fields that the policy lacks."""
    fields = {field.name: field for field in c.folder.race.fields}
    parts = []
    for name, size in VEHICLE:
        at = fields[name].start if name in fields else None
        zeros = np.zeros((len(states), size), np.float32)
        parts.append(zeros if at is None else states[:, at : at + size])
    return np.concatenate(parts, axis=1)


def _counted_states(c: Context) -> np.ndarray:
    """A few states of the flights, and of any bits."""
    simulated, any_bits = c.folder.rollouts.states, c.loader.states[0]
    rows = [np.linspace(0, len(x) - 1, COUNTED).astype(int) for x in (simulated, any_bits)]
    return np.concatenate([simulated[rows[0]], any_bits[rows[1]]]).astype(np.float32)


def _count(c: Context, build: Build, compiler: Compiler) -> dict[str, tuple[int, int]]:
    """Instructions, at most, and stack: of loading, of a step, and of the network alone."""
    loader = c.loader
    extra = [f"-I{loader.folder}", *loader.runtime.options, *flags_of(compiler, "harness_load")]
    sources = [*loader.harness, write_memory(c.work)]
    machine = machine_of(compiler.build(sources, c.work / f"{build.tag}_qjp.elf", extra), build)
    words, struct = machine.place(loader.words), machine.reserve(LARGEST_STRUCT)
    race, out = machine.reserve(64), machine.reserve(64)
    require(
        machine.call("harness_load", words, len(loader.data)) == 0, "the loader rejects the file"
    )
    states, pilot = _counted_states(c), loader.runtime.has_pilot
    if pilot:
        arguments = (struct, words, len(loader.data), int(loader.runtime.rotor_speeds))
        require(machine.call("qjp_pilot_load", *arguments) == 0, "the pilot rejects the file")
        used = {"loading": machine.count("qjp_pilot_load", *arguments)}
        name, memory, rows = "qjp_pilot_step", struct, _vehicles(c, states)
    else:
        used = {"loading": machine.count("qjp_load", struct, words, len(loader.data))}
        name, memory, rows = "harness_step", race, states
    steps = np.array([machine.count(name, memory, machine.place(row), out) for row in rows])
    q = loader.inputs[np.linspace(0, len(loader.inputs) - 1, COUNTED).astype(int)]
    policy = machine.symbols["policy"]
    network = [machine.count("qjp_forward", policy, machine.place(row), out, 0) for row in q]
    for key, counts in (("step", steps), ("network", np.array(network))):
        used[key] = (int(counts[:, 0].max()), int(counts[:, 1].max()))
    return used


def check_step(c: Context) -> str:
    """Instructions and stack of all that runs on board: at each step, and once at loading."""
    need_emulator()
    name = "qjp_pilot_step" if c.loader.runtime.has_pilot else "gates, observation, network"
    parts = []
    for build, compiler in compilers_of(c):
        used = _count(c, build, compiler)
        (step, stack), (loading, more) = used["step"], used["loading"]
        check_stack(c, stack)
        parts.append(f"{build.label} {step:,}, {stack} B stack; loading {loading:,}, {more} B")
    return f"{name}: {'; '.join(parts)}"


def check_memory(c: Context) -> str:
    """Memory of the C that flies and of the words of the file."""
    need_emulator()
    loader, parts = c.loader, []
    for build, compiler in compilers_of(c):
        extra = [f"-I{loader.folder}", *loader.runtime.options, *flags_of(compiler, "qjp_load")]
        sources = [*loader.sources, write_memory(c.work)]
        read_only, writable = sizes_of(
            compiler.build(sources, c.work / f"{build.tag}_qjp_sizes.elf", extra)
        )
        parts.append(f"{compiler.name} {read_only:,} B flash, {writable} B writable data")
    glue = f"; without {loader.runtime.glue}" if loader.runtime.glue else ""
    return f"{', '.join(parts)}; words {len(loader.data):,} B {loader.runtime.words}{glue}"


def check_against_float(c: Context) -> str:
    """Instructions of the network, and those of float C with the same compiler and flags.

    The loader quantizes the state, not the network's inputs: its network begins with integers.
    """
    need_emulator()
    parts = []
    for build, compiler in compilers_of(c):
        fixed, _ = _count(c, build, compiler)["network"]
        single = float_instructions(c, build, compiler)
        parts.append(f"{build.label} {fixed:,} (float {single:,})")
    return f"network without quantization: {'; '.join(parts)}"


def check_eva(c: Context) -> str:
    """Frama-C EVA of the C with the words: no alarm for any state and any memory.

    Words that the loader would reject, with weights at their largest, raise alarms.
    """
    need_program("frama-c")
    loader = c.loader
    main = _eva_main(c, c.work / "qjp_eva", loader.data)
    sources = [path for path in loader.sources if path.name != "qjp_load.c"]
    count = proven(c, main, sources, loader.folder)
    words, start = loader.words.copy(), table_start(loader.words)
    words[start : start + 4 * c.folder.network.inputs : 4] = 2**31 - 1
    alarms, _ = eva(
        c, _eva_main(c, c.work / "qjp_corrupted", words.tobytes()), sources, loader.folder
    )
    require(alarms > 0, "weights that may overflow raised no alarm")
    return (
        f"0 alarms for any state and memory after loading; {count} assertions proven; "
        f"weights that may overflow: {alarms} alarms"
    )


def _eva_main(c: Context, folder: Path, data: bytes) -> Path:
    """The main function of the proof and the words, in a folder of their own."""
    network, pilot = c.folder.network, c.loader.runtime.has_pilot
    write_text(folder / "words.h", words_header("policy", data))
    values = {"network": network, "pilot": pilot}
    write_text(folder / "eva_main.c", render("qjp/eva_main.c", values))
    return folder / "eva_main.c"


def check_cppcheck(c: Context) -> str:
    """Cppcheck without a finding, of the C that flies."""
    return cppcheck(c.loader.sources, c.loader.folder)
