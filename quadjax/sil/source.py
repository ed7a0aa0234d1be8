"""The exported C of a folder behind the messages, compiled for this machine."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.export.render import render, wrapped
from quadjax.export.targets import RUNTIME, pilot_options, sources_of, target_of
from quadjax.export.verify.folder import Inputs
from quadjax.export.verify.result import Failed, Skipped
from quadjax.export.verify.toolchain import Compiler, host
from quadjax.sil.message import DTYPES, HEADER, HEADER_FIELDS, PAYLOADS, VERSION, Fields, Kind
from quadjax.sil.worlds import command_kind

HOST = RUNTIME / "host"


@dataclasses.dataclass(frozen=True)
class Sources:
    """C to compile: files of the export, and files around it."""

    files: tuple[Path, ...]
    include: Path
    text: str  # the files that fly, and the autopilot's glue that does not
    options: tuple[str, ...]  # of the compiler

    def build(self, work: Path, shared: bool = False) -> Path:
        """Compile the autopilot as a program, or as a shared library without the socket.

        Args:
            work: a folder for what is built.
            shared: build a library with ``sil_begin`` and ``sil_step``.

        Raises:
            InputError: no compiler, or C that does not compile.
        """
        output = work / ("autopilot.so" if shared else "autopilot")
        own = [HOST / "sil.c"] if shared else [HOST / "sil.c", HOST / "process.c"]
        options = ["-shared", "-fPIC"] if shared else []
        options += [f"-I{self.include}", f"-I{work}", *self.options]
        try:
            compiler = _unchanged_arithmetic(host())
            return compiler.build([*self.files, *own], output, options)
        except (Skipped, Failed) as error:
            raise InputError(f"{self.include}: the C cannot be compiled: {error}") from None


def label_of(program: Path, folder: Path) -> str:
    """The name of an autopilot that is built, for the table.

    Raises:
        InputError: its pilot refuses the policy.
    """
    done = subprocess.run([str(program)], capture_output=True, text=True)
    if done.stdout.strip():
        raise InputError(f"{folder}: the policy cannot fly here: {done.stdout.strip()}")
    return "exported C, its own estimator" if done.returncode else "exported C"


def _unchanged_arithmetic(compiler: Compiler) -> Compiler:
    """The compiler without fused multiplications, so that every machine computes the same."""
    return dataclasses.replace(compiler, flags=(*compiler.flags, "-ffp-contract=off"))


def write_sources(folder: Path, inputs: Inputs, rate: float, work: Path) -> Sources:
    """Write the C around the pilot of an exported folder, with what its autopilot measures.

    External moment and force are those of the drone, unless the policy's own estimator runs, which
    was exported for the rate of the messages.

    Args:
        folder: of ``quadjax export``.
        inputs: of that folder.
        rate: of the messages, Hz.
        work: a folder for the files.

    Raises:
        InputError: a C file is missing.
    """
    name, model = inputs.options.name, inputs.own.choices.model
    target = target_of(inputs.options.target, model.name)
    files = tuple(folder / file for file in sources_of(target))
    for path in (*files, folder / f"{name}.qjp"):
        check_file(path)
    words = np.frombuffer((folder / f"{name}.qjp").read_bytes(), "<i4")
    body = wrapped(str(x) if x > -(2**31) else "(-2147483647 - 1)" for x in words.tolist())
    table = f"static const int32_t quadjax_words[{len(words)}] = {{\n{body}}};\n"
    (work / "quadjax_words.h").write_text(table)
    (work / "message.h").write_text(header_text(functions=True))
    text = f"{name}.qjp, {target.folder}/{{{','.join(path.name for path in files)}}}"
    text += f"; without the glue of {target.autopilot}" if target.glue else ""
    options = [*pilot_options(target, round(1e9 / rate), disturbances=True)]
    options.append(f"-DCOMMAND_KIND={int(command_kind(model))}")
    return Sources(files, folder / target.folder, text, tuple(options))


def header_text(functions: bool = False) -> str:
    """The messages as a C header, for autopilots in C.

    Args:
        functions: also declare those of the exported C behind the messages.
    """
    structs: list[tuple[str, Fields]] = [("sil_header", HEADER_FIELDS)]
    structs += [(f"sil_{kind.name.lower()}", fields) for kind, fields in PAYLOADS.items() if fields]
    sizes = {f"sil_{kind.name.lower()}": DTYPES[kind].itemsize for kind in Kind}
    sizes["sil_header"] = HEADER.itemsize
    values = {"version": VERSION, "structs": structs, "sizes": sizes, "functions": functions}
    return render("message.h", values)


def check_byte_order() -> None:
    """Reject a big-endian machine: the C copies the messages' numbers as they are.

    Raises:
        InputError: this machine is big-endian.
    """
    if sys.byteorder != "little":
        raise InputError("this machine is big-endian, allowed: little-endian")
