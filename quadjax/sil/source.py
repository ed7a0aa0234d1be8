"""The exported C of a folder behind the messages, compiled for this machine."""

import dataclasses
import sys
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.export.indiflight import FOLDER, MOTORS
from quadjax.export.race_tables import state_sizes
from quadjax.export.render import render
from quadjax.export.targets import INDIFLIGHT, find_target
from quadjax.export.verify.folder import Inputs
from quadjax.export.verify.result import Failed, Skipped
from quadjax.export.verify.toolchain import Compiler, host
from quadjax.race.layout import HIGHEST_RPM
from quadjax.sil.message import (
    DTYPES,
    HEADER,
    HEADER_FIELDS,
    PAYLOADS,
    RPM_PER_RAD_S,
    VERSION,
    Fields,
    Kind,
)
from quadjax.sil.worlds import command_kind

SAME_RATE = 1e-6  # relative difference of rates that count as equal


@dataclasses.dataclass(frozen=True)
class Sources:
    """C to compile: files of the export, and files around it."""

    files: tuple[Path, ...]
    include: Path
    own_estimator: bool  # the export's disturbance estimator runs, not the drone's
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
        own = [work / "autopilot.c"] if shared else [work / "autopilot.c", work / "process.c"]
        options = ["-shared", "-fPIC"] if shared else []
        options += [f"-I{self.include}", f"-I{work}", *self.options]
        try:
            compiler = _unchanged_arithmetic(host())
            return compiler.build([*self.files, *own], output, [*options, "-lm"])
        except (Skipped, Failed) as error:
            raise InputError(f"{self.include}: the C cannot be compiled: {error}") from None


def _unchanged_arithmetic(compiler: Compiler) -> Compiler:
    """The compiler without fused multiplications, so that every machine computes the same."""
    return dataclasses.replace(compiler, flags=(*compiler.flags, "-ffp-contract=off"))


def write_sources(folder: Path, inputs: Inputs, rate: float, work: Path) -> Sources:
    """Write the C around an exported folder.

    The disturbance estimator of the export runs if it was exported for the rate of the messages.
    The estimator of the highest propeller speed must have been exported for that rate.

    Args:
        folder: of ``quadjax export``.
        inputs: of that folder.
        rate: of the messages, Hz.
        work: a folder for the files.

    Raises:
        InputError: a C file is missing; an estimator of the highest speed for another rate.
    """
    name, model = inputs.options.name, inputs.own.choices.model
    indiflight = find_target(inputs.options.target).autopilot == INDIFLIGHT
    if indiflight:
        names = [f"{FOLDER}/neural_network.c", f"{FOLDER}/nn_controller.c"]
    else:
        names = [f"{name}.c", f"{name}_race.c"]
    fields = state_sizes(inputs.own.choices.layout, model)
    same_rate = abs(inputs.options.sample_rate / rate - 1.0) < SAME_RATE
    own = "moment_ext" in fields and same_rate and (folder / f"{name}_estimator.c").is_file()
    names += [f"{name}_estimator.c"] if own else []
    battery = HIGHEST_RPM in fields
    if battery and not same_rate:
        raise InputError(_other_rate(inputs.options.sample_rate, rate))
    names += [f"{name}_battery.c"] if battery else []
    for file in names:
        check_file(folder / file)
    policy = inputs.policy
    values = {
        "name": name,
        "NAME": name.upper(),
        "fields": list(fields),
        "indiflight": indiflight,
        "own_estimator": own,
        "battery": battery,
        "motors": MOTORS,
        "rpm": model.commands[0].unit == "rpm",
        "rpm_per_rad_s": RPM_PER_RAD_S,
        "command_type": "uint16_t" if model.commands[0].unit == "rpm" else "float",
        "halfway": 0.5 * (policy.command_low + policy.command_high),
        "command_kind": int(command_kind(model)),
    }
    for file in ("autopilot.c", "process.c"):
        (work / file).write_text(render(f"sil/{file}", values))
    (work / "message.h").write_text(header_text(functions=True))
    include = folder / FOLDER if indiflight else folder
    options = (f"-DNN_CONTROL_HZ={round(rate)}",) if indiflight else ()
    return Sources(tuple(folder / file for file in names), include, own, options)


def _other_rate(exported: float, rate: float) -> str:
    return (
        f"the policy observes {HIGHEST_RPM}, whose estimator was exported for {exported:g} Hz; the "
        f"drone's control steps are at {rate:g} Hz: export it with --sample-rate {rate:g}"
    )


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
    return render("sil/message.h", values)


def check_byte_order() -> None:
    """Reject a big-endian machine: the C copies the messages' numbers as they are.

    Raises:
        InputError: this machine is big-endian.
    """
    if sys.byteorder != "little":
        raise InputError("this machine is big-endian, allowed: little-endian")
