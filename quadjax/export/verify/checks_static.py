"""Checks that need no vectors to find a fault: sanitizers, Frama-C, cppcheck."""

import re
import subprocess
from pathlib import Path

from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import write_eva_main, write_harness
from quadjax.export.verify.result import Failed, Skipped, require
from quadjax.export.verify.toolchain import Compiler, host, need_program

SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all -g -O1".split()
SANITIZED_VECTORS = 5_000
EVA_SECONDS = 600
EVA = "-machdep gcc_x86_32 -eva -eva-slevel 40000 -warn-special-float none".split()


def check_sanitizers(c: Context) -> str:
    """Address and undefined-behavior sanitizers over ordinary and hostile vectors."""
    compiler = host()
    if compiler.name == "zig cc":
        raise Skipped("needs gcc or clang on this machine")
    folder = c.folder
    strict = Compiler(compiler.name, compiler.command, ("-std=c99", *SANITIZERS))
    extra = ["-DHARNESS_MAIN", f"-I{folder.path}"]
    sources = [*folder.files, write_harness(folder, c.work)]
    program = strict.build(sources, c.work / "sanitized", extra)
    count = c.run([str(program)], "sanitized", "s", SANITIZED_VECTORS)
    return f"{count} vectors and all self-tests, no report"


def eva(c: Context, main: Path, sources: list[Path], include: Path) -> tuple[int, str]:
    """Alarms and the output of Frama-C's EVA.

    Args:
        c: the verification.
        main: C with the function ``eva_main``.
        sources: the C that it calls.
        include: folder of the headers.

    Raises:
        Failed: an error, or no result in time.
    """
    program = need_program("frama-c")
    widest = max(max(layer.weights.shape) for layer in c.folder.network.layers)
    unroll = str(max(130, widest + 10))
    command = [program, *EVA, "-eva-min-loop-unroll", unroll, "-main", "eva_main"]
    command += [f"-cpp-extra-args=-I{include}", *map(str, [main, *sources])]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=EVA_SECONDS)
    except subprocess.TimeoutExpired:
        raise Failed(f"frama-c: no result within {EVA_SECONDS} s") from None
    found = re.search(r"(\d+) alarms? generated", done.stdout)
    if done.returncode or not found:
        lines = (done.stdout + done.stderr).strip().splitlines() or ["no output"]
        raise Failed(f"frama-c: {lines[-1]}")
    return int(found[1]), done.stdout


def proven(c: Context, main: Path, sources: list[Path], include: Path) -> int:
    """Assertions that EVA proves, without an alarm.

    Raises:
        Failed: an alarm, or an assertion that is not proven.
    """
    alarms, text = eva(c, main, sources, include)
    require(alarms == 0, f"{alarms} alarms")
    found = re.search(r"Assertions\s+(\d+) valid\s+(\d+) unknown\s+(\d+) invalid", text)
    require(found is not None, "no assertion was reached")
    assert found is not None
    require(found[2] == "0" and found[3] == "0", f"assertions: {found[0]}")
    return int(found[1])


def check_eva(c: Context) -> str:
    """Frama-C EVA: no alarm for any input, the output's range proven; a corrupted row alarms."""
    need_program("frama-c")
    count = proven(c, write_eva_main(c.folder, c.work), c.folder.files, c.folder.path)
    return (
        f"0 alarms for any input; {count} assertions proven; "
        f"a corrupted row: {_corrupted_alarms(c)} alarms"
    )


def _corrupted_alarms(c: Context) -> int:
    """Alarms with the first row's weights at their largest: its sum may then overflow."""
    folder = c.folder
    text = folder.expected[f"{folder.name}.c"]
    start = text.index("{", text.index("weight_0[")) + 1
    end = text.index("}", start)
    numbers = text[start:end].replace("\n", " ").split(",")
    for index in range(0, len(numbers), 4):
        numbers[index] = "2147483647"
    source = c.work / f"{folder.name}.c"
    source.write_text(text[:start] + ",".join(numbers) + text[end:])
    others = [f for f in folder.files if f.name != source.name]
    main = write_eva_main(c.folder, c.work)
    alarms, _ = eva(c, main, [source, *others], c.folder.path)
    require(alarms > 0, "a corrupted row raised no alarm")
    return alarms


def check_cppcheck(c: Context) -> str:
    """Cppcheck without a finding."""
    return cppcheck(c.folder.files, c.folder.path)


def cppcheck(files: list[Path], include: Path) -> str:
    """The result for C sources, with the folder of their headers."""
    program = need_program("cppcheck")
    command = [
        program,
        "--enable=warning,performance,portability",
        "--error-exitcode=1",
        "--std=c99",
    ]
    command += ["--inline-suppr", "--quiet", f"-I{include}", *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    require(done.returncode == 0 and not lines, lines[0] if lines else "failed")
    return f"{len(files)} files, no finding"
