"""The exported C of a policy, compiled for this machine and called by messages."""

import subprocess
import sys
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.export.conversion import Converted
from quadjax.export.verify.autopilot import build_autopilot
from quadjax.export.verify.build import HOST, Sources
from quadjax.export.verify.result import Failed, Skipped
from quadjax.plant.config import PlantConfig
from quadjax.sil.message import DTYPES, HEADER, HEADER_FIELDS, PAYLOADS, VERSION, Fields, Kind
from quadjax.sil.worlds import command_kind

C_TYPES = {"S1": "char", "<u2": "uint16_t", "<u4": "uint32_t", "<f4": "float", "<f8": "double"}
FUNCTIONS = [  # of sil.c
    "",
    "const char *sil_load(void);       /* 0, or why the policy cannot fly */",
    "uint32_t sil_own_estimator(void); /* whether the policy's estimator of disturbances runs */",
    "void sil_begin(void);             /* a race begins with the next state */",
    "void sil_step(const sil_state *from, sil_command *to);",
]
SAME_LOOP = 0.03  # largest relative difference of the loop rates of plant and autopilot


def at_rate(plant: PlantConfig, sources: Sources) -> PlantConfig:
    """The plant at the loop rate of an autopilot, if the two differ by at most ``SAME_LOOP``.

    The estimators and filters of the C are made for the rate of its calls.
    """
    ratio = 1e9 / sources.call_ns / plant.control_rate
    if abs(ratio - 1.0) > SAME_LOOP or ratio == 1.0:
        return plant
    rates = {name: ratio * getattr(plant, name) for name in ("sample_rate", "control_rate")}
    return plant.replace(**rates)


def build(
    converted: Converted, sources: Sources, rate: float, shared: bool = False
) -> tuple[Path, str]:
    """Compile the C that the target flies: with its glue in a stand-in for its firmware.

    The glue is called at its own rate, or the nearest with a whole number of calls per message, or
    of messages per call. Firmware without glue calls the pilot at every message.

    Args:
        converted: the policy.
        sources: the C, as the converter writes it.
        rate: of the messages, Hz.
        shared: build a library with ``sil_begin`` and ``sil_step``, without the socket.

    Returns:
        The program or library, and the names of the files that fly.

    Raises:
        InputError: no compiler, or C that does not compile.
    """
    target, folder = sources.target, sources.folder
    ratio = 1e9 / sources.call_ns / rate if target.glue else 1.0
    calls = round(ratio) if ratio >= 1.0 else 1.0 / round(1.0 / ratio)
    call_ns = round(1e9 / (rate * calls))
    if not target.glue:
        sources = Sources(target, folder, call_ns)
    (folder / "stand_in" / "message.h").write_text(header_text(functions=True))
    names = ("sil.c",) if shared else ("sil.c", "process.c")
    kind = int(command_kind(converted.race.choices.model))
    options = [f"-DFIRMWARE_CALL_NS={call_ns}U", f"-DCOMMAND_KIND={kind}"]
    output = folder / ("autopilot.so" if shared else "autopilot")
    try:
        build_autopilot(sources, output, [HOST / name for name in names], options)
    except (Skipped, Failed) as error:
        raise InputError(f"the C cannot be compiled: {error}") from None
    flying = ",".join(path.name for path in sources.flying)
    text = f"{converted.options.name}.qjp, {target.folder}/{{{flying}}}"
    return output, text + (f", in the glue of {target.autopilot}" if target.glue else "")


def label_of(program: Path, converted: Converted) -> str:
    """The label of an autopilot's program, for the table.

    Raises:
        InputError: its glue or its pilot rejects the policy.
    """
    done = subprocess.run([str(program)], capture_output=True, text=True)
    if done.stdout.strip():
        raise InputError(f"{converted.file}: the policy cannot fly here: {done.stdout.strip()}")
    estimator = ", its own estimator" * bool(done.returncode)
    return f"exported C{estimator}{', sampled actions' * (converted.fixed.noise is not None)}"


def header_text(functions: bool = False) -> str:
    """The messages as a C header, for autopilots in C.

    Args:
        functions: also declare the functions that the messages call.
    """
    structs: list[tuple[str, Fields]] = [("header", HEADER_FIELDS)]
    structs += [(kind.name.lower(), fields) for kind, fields in PAYLOADS.items() if fields]
    sizes = {kind.name.lower(): DTYPES[kind].itemsize for kind in Kind} | {
        "header": HEADER.itemsize
    }
    kinds = ", ".join(f"SIL_{kind.name} = {int(kind)}" for kind in Kind)
    lines = [f"enum {{ SIL_VERSION = {VERSION} }};", f"enum {{ {kinds} }};"]
    for name, fields in structs:
        size = sizes[name]
        lines += ["", f"/* {size} bytes, little-endian, without padding. */", "typedef struct {"]
        lines += ["  sil_header header;"] * (name != "header")
        for field, kind, count, note in fields:
            array = f"[{count}]" if count > 1 else ""
            lines.append(f"  {C_TYPES[kind]} {field}{array}; /* {note} */")
        check = f"sizeof(sil_{name}) == {size} ? 1 : -1"
        lines += [f"}} sil_{name};", f"typedef char sil_{name}_has_its_size[{check}];"]
    lines += FUNCTIONS if functions else []
    return (
        f"/* Messages of format quadjax-sil/{VERSION}: see the reference, Software-in-the-loop "
        "messages. */\n#ifndef SIL_MESSAGE_H\n#define SIL_MESSAGE_H\n\n#include <stdint.h>\n\n"
        + "\n".join([*lines, "", "#endif", ""])
    )


def check_byte_order() -> None:
    """Reject a big-endian machine: the C copies the messages' numbers as they are.

    Raises:
        InputError: this machine is big-endian.
    """
    if sys.byteorder != "little":
        raise InputError("this machine is big-endian, allowed: little-endian")
