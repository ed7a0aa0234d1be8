"""The exported C of a folder behind the messages, compiled for this machine."""

import subprocess
import sys
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.export.folder import Inputs
from quadjax.export.read import read_qjp
from quadjax.export.render import render, words_table
from quadjax.export.targets import RUNTIME, pilot_options, sources_of, target_of
from quadjax.export.verify.result import Failed, Skipped
from quadjax.export.verify.toolchain import host
from quadjax.sil.message import DTYPES, HEADER, HEADER_FIELDS, PAYLOADS, VERSION, Fields, Kind
from quadjax.sil.worlds import command_kind


def build_autopilot(
    folder: Path, inputs: Inputs, rate: float, work: Path, shared: bool = False
) -> tuple[Path, str]:
    """Compile the C of an exported folder with its pilot, and what its autopilot measures.

    External moment and force are those of the drone, unless the policy's own estimator runs, which
    was exported for the rate of the messages. Multiplications are not fused, so that every machine
    computes the same.

    Args:
        folder: of ``quadjax export``.
        inputs: of that folder.
        rate: of the messages, Hz.
        work: a folder for what is built.
        shared: build a library with ``sil_begin`` and ``sil_step``, without the socket.

    Returns:
        The program or library, and the names of the files that fly, with the glue that does not.

    Raises:
        InputError: a C file is missing, words that are damaged, no compiler, or C that does not
            compile.
    """
    model, include = inputs.own.choices.model, work / "include"
    target = target_of(inputs.options.target, model.name)
    files, words = [folder / file for file in sources_of(target)], words_of(folder, inputs)
    for path in files:
        check_file(path)
    read_qjp(words)
    include.mkdir()
    (include / "quadjax_words.h").write_text(words_table("quadjax_words", words.read_bytes()))
    (include / "message.h").write_text(header_text(functions=True))
    options = pilot_options(target, round(1e9 / rate), disturbances=True)
    options += [f"-DCOMMAND_KIND={int(command_kind(model))}", "-ffp-contract=off"]
    options += [f"-I{folder / target.folder}", f"-I{include}"]
    names = ("sil.c",) if shared else ("sil.c", "process.c")
    output = work / ("autopilot.so" if shared else "autopilot")
    options += ["-shared", "-fPIC"] if shared else []
    try:
        host().build([*files, *(RUNTIME / "host" / name for name in names)], output, options)
    except (Skipped, Failed) as error:
        raise InputError(f"{folder}: the C cannot be compiled: {error}") from None
    text = f"{words.name}, {target.folder}/{{{','.join(path.name for path in files)}}}"
    return output, text + (f"; without the glue of {target.autopilot}" if target.glue else "")


def words_of(folder: Path, inputs: Inputs) -> Path:
    """The file of the policy's words in an exported folder."""
    return folder / f"{inputs.options.name}.qjp"


def label_of(program: Path, words: Path) -> str:
    """The name of an autopilot that is built, for the table.

    Raises:
        InputError: its pilot refuses the words of the policy.
    """
    done = subprocess.run([str(program)], capture_output=True, text=True)
    if done.stdout.strip():
        raise InputError(f"{words}: the policy cannot fly here: {done.stdout.strip()}")
    return "exported C, its own estimator" if done.returncode else "exported C"


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
