"""Checks of a ``.qjp`` file and of the C that loads it: the same bits, and mutated files."""

import functools
import subprocess
from collections.abc import Callable

import numpy as np

from quadjax.export import emulator, race_emulator
from quadjax.export.integers import ONE, quantize
from quadjax.export.qjp.policy import OUTPUTS, QjpPolicy
from quadjax.export.verify.checks_arm import need_emulator
from quadjax.export.verify.checks_static import SANITIZERS
from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import write_memory
from quadjax.export.verify.loader import LoaderLibrary, QjpContext
from quadjax.export.verify.result import Failed, Skipped, require
from quadjax.export.verify.toolchain import WARNINGS, Compiler, arm_none_eabi, host, zig_thumb

MUTATIONS = 2_000  # of a file, unless more are asked for
COUNTED = 8  # inferences whose instructions are counted
PATHS, STEPS = 200, 8  # positions on which gates are counted


def expected_forward(policy: QjpPolicy, q: np.ndarray) -> np.ndarray:
    """Rows (n, 5) int32, commands and trace, by the NumPy emulator."""
    commands, trace = emulator.forward_traced(policy.network, q)
    digest = emulator.trace_digest(trace).view(np.int32)
    return np.column_stack([commands, digest])


def expected_inputs(policy: QjpPolicy, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Rows (n, inputs + 3) int32 by the NumPy emulator."""
    seen = race_emulator.observe(policy.race, states, targets)
    status = np.stack([seen.clipped, seen.nan, seen.outside], axis=1)
    return np.concatenate([seen.q, status.astype(np.uint32).view(np.int32)], axis=1)


def check_file(c: QjpContext) -> str:
    """Python reads the file, repeats its proof and its self-tests."""
    network, race = c.policy.network, c.policy.race
    widths = "-".join(str(x) for x in (network.inputs, *(len(y.bias) for y in network.layers)))
    return f"{len(c.data):,} bytes, {widths}, {race.gates} gates, proof and self-tests repeated"


def check_warnings(c: QjpContext) -> str:
    """No warning from any compiler that is found."""
    makers = [host, *(functools.partial(zig_thumb, x) for x in c.processors)]
    makers += [functools.partial(arm_none_eabi, x) for x in c.processors]
    names = []
    for make in makers:
        try:
            compiler: Compiler = make()
        except Skipped:
            continue
        for source in c.sources:
            extra = [*WARNINGS, *c.runtime.options, "-c"]
            compiler.build([source], c.work / "warnings.o", extra)
        names.append(compiler.name)
    require(bool(names), "no compiler")
    return ", ".join(dict.fromkeys(names))


def check_host(c: QjpContext) -> str:
    """The loader on this machine gives the emulators' commands, traces, inputs and gates."""
    library, policy = c.library, c.policy
    rows = library.forward(c.inputs)
    require(np.array_equal(rows, expected_forward(policy, c.inputs)), "other commands")
    states, targets = c.states
    seen = library.observe(states, targets)
    require(np.array_equal(seen, expected_inputs(policy, states, targets)), "other inputs")
    passed, missed = _check_events(library, policy)
    return (
        f"{len(rows)} inputs and {len(states)} states the same; {passed} gates passed and "
        f"{missed} missed at the same steps"
    )


def _check_events(library: LoaderLibrary, policy: QjpPolicy) -> tuple[int, int]:
    """Gates passed and missed on short paths to and fro through every gate."""
    race, rng, counts = policy.race, np.random.default_rng(7), np.zeros(3, int)
    unit = np.ldexp(1.0, race.exponent("position")) / ONE
    exponents = (race.exponent("position"),) * 3
    for path in range(PATHS):
        gate = path % race.gates
        steps = rng.uniform(-1.2, 1.2, (STEPS, 3)) * np.append(1.0, race.half_size[gate] * unit)
        places = race.gate_position[gate] * unit + steps @ (race.axes[gate] / ONE)
        places = np.ascontiguousarray(places, np.float32)
        rows = library.events(places, gate)
        target, before = gate, quantize(places[:1], exponents)
        for now, row in zip(quantize(places, exponents), rows.tolist(), strict=True):
            event = int(race_emulator.gate_event(race, before, now[None], np.array([target]))[0])
            target = (target + (event == race_emulator.PASSED)) % race.gates
            require([event, target] == row, f"another event at gate {gate}")
            counts[event] += 1
            before = now[None]
    return int(counts[race_emulator.PASSED]), int(counts[race_emulator.MISSED])


def check_machine(c: QjpContext) -> str:
    """The loader on the emulated processors: the same bits; its instructions and stack."""
    need_emulator()
    return "; ".join(_machine(c, processor) for processor in c.processors)


def _machine(c: QjpContext, processor: str) -> str:
    from quadjax.export.verify.machine import Machine  # needs packages of an extra

    compiler = zig_thumb(processor)
    sources = [*c.harness, write_memory(c.work)]
    flags = ["-Wl,-e,harness_load", f"-I{c.folder}", *c.runtime.options]
    elf = compiler.build(sources, c.work / f"{processor}.elf", flags)
    machine = Machine(elf, processor)
    words = machine.place(c.words)
    size = machine.reserve(4096)  # of a qjp_policy, more than enough
    used = [machine.count("qjp_load", size, words, len(c.data))]
    require(machine.call("harness_load", words, len(c.data)) == 0, "the loader rejects the file")
    q, out = c.inputs[:: max(1, len(c.inputs) // 500)], machine.reserve(32 * len(c.inputs))
    machine.call("harness_forward", machine.place(q), out, len(q))
    rows = machine.read(out, np.int32, (len(q), OUTPUTS + 1))
    require(np.array_equal(rows, expected_forward(c.policy, q)), f"{processor}: other commands")
    states, targets = (x[:: max(1, len(x) // 500)] for x in c.states)
    width = c.policy.network.inputs + 3
    seen = machine.reserve(4 * width * len(states))
    goals = machine.place(targets.astype(np.uint32))
    machine.call("harness_observe", machine.place(states), goals, seen, len(states))
    found = machine.read(seen, np.int32, (len(states), width))
    wanted = expected_inputs(c.policy, states, targets)
    require(np.array_equal(found, wanted), f"{processor}: other inputs")
    places = [machine.place(row) for row in q[:COUNTED]]
    used += [machine.count("qjp_forward", size, place, out, 0) for place in places]
    counts, stack = [count for count, _ in used[1:]], max(own for _, own in used[1:])
    return (
        f"{processor}: {len(q)} inputs and {len(states)} states the same; an inference "
        f"{max(counts):,} instructions, {stack} B stack; loading {used[0][0]:,}, {used[0][1]} B"
    )


def check_mutations(c: QjpContext) -> str:
    """Mutated files: none crashes, none is accepted that should not be."""
    compiler = host()
    if compiler.name == "zig cc":
        raise Skipped("needs gcc or clang on this machine, with sanitizers")
    strict = Compiler(compiler.name, compiler.command, ("-std=c99", *SANITIZERS, "-O2"))
    sources = [*c.sources, c.folder / "fuzz.c"]
    program = strict.build(sources, c.work / "fuzz", c.runtime.options)
    command = [str(program), str(c.work / "policy.qjp"), str(c.mutations), "0"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = (done.stdout + done.stderr).strip().splitlines() or ["no output"]
        raise Failed(f"exit status {done.returncode}: {lines[0]}")
    counts = {name: int(n) for name, n in (x.rsplit(" ", 1) for x in done.stdout.splitlines())}
    unchanged, accepted = counts["unchanged"], counts["ok"]
    rejected = counts["mutants"] - accepted
    return (
        f"{counts['mutants']:,} mutants, half with a new hash: {rejected:,} rejected, {unchanged} "
        f"unchanged, {accepted - unchanged:,} accepted with a new hash and ranges that hold; no "
        "report of ASan and UBSan"
    )


Check = Callable[[QjpContext], str]
QJP_CHECKS: dict[str, Check] = {
    ".qjp, file": check_file,
    ".qjp, warnings": check_warnings,
    ".qjp, host": check_host,
    ".qjp, emulated": check_machine,
    ".qjp, mutations": check_mutations,
}


def folder_checks() -> dict[str, Callable[[Context], str]]:
    """The checks of a file, for the one of an exported folder."""

    def run(check: Check, c: Context) -> str:
        return check(c.loader)

    return {name: functools.partial(run, check) for name, check in QJP_CHECKS.items()}
