"""The exported C of a folder behind the messages, compiled for this machine."""

import dataclasses
import sys
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.export.indiflight import FOLDER, MOTORS
from quadjax.export.qjp.autopilots import RUNTIMES, Runtime, words_header
from quadjax.export.race_tables import state_sizes
from quadjax.export.render import render
from quadjax.export.targets import AS_FILE, INDIFLIGHT, find_target
from quadjax.export.verify.folder import Inputs
from quadjax.export.verify.result import Failed, Skipped
from quadjax.export.verify.toolchain import Compiler, host
from quadjax.race.observations import HIGHEST_RPM
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
    label: str  # for the table
    text: str  # the files that fly, and the autopilot's glue that does not
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

    A policy as a file flies by its loader, and by its pilot where the export has one.
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
    autopilot = find_target(inputs.options.target).autopilot
    if autopilot in AS_FILE:
        sources = _of_file(folder, inputs, RUNTIMES[autopilot], work)
    else:
        sources = _generated(folder, inputs, rate, work)
    for path in sources.files:
        check_file(path)
    (work / "process.c").write_text(render("sil/process.c", _values(inputs)))
    (work / "message.h").write_text(header_text(functions=True))
    return sources


def _values(inputs: Inputs) -> dict[str, object]:
    """Values of all templates."""
    name, model, policy = inputs.options.name, inputs.own.choices.model, inputs.policy
    rpm = model.commands[0].unit == "rpm"
    return {
        "name": name,
        "NAME": name.upper(),
        "rpm": rpm,
        "rpm_per_rad_s": RPM_PER_RAD_S,
        "command_type": "uint16_t" if rpm else "float",
        "halfway": 0.5 * (policy.command_low + policy.command_high),
        "command_kind": int(command_kind(model)),
    }


def _of_file(folder: Path, inputs: Inputs, runtime: Runtime, work: Path) -> Sources:
    """The loader, or the pilot, with the words of the file."""
    values, words = _values(inputs), folder / f"{inputs.options.name}.qjp"
    check_file(words)
    values |= {"pilot": runtime.has_pilot, "rotor_speeds": int(runtime.rotor_speeds)}
    (work / "autopilot.c").write_text(render("sil/qjp_autopilot.c", values))
    (work / "qjp_data.h").write_text(words_header(inputs.options.name, words.read_bytes()))
    files = tuple(folder / file for file in runtime.files)
    text = f"{words.name}, {runtime.folder}/{{{','.join(runtime.names)}}}"
    text += f"; without {runtime.glue}" if runtime.glue else ""
    label = "pilot of the .qjp" if runtime.has_pilot else "loader of the .qjp"
    return Sources(files, folder / runtime.folder, label, text, False, runtime.options)


def _generated(folder: Path, inputs: Inputs, rate: float, work: Path) -> Sources:
    """The generated C, or INDIflight's."""
    name = inputs.options.name
    indiflight = find_target(inputs.options.target).autopilot == INDIFLIGHT
    if indiflight:
        names = [f"{FOLDER}/neural_network.c", f"{FOLDER}/nn_controller.c"]
    else:
        names = [f"{name}.c", f"{name}_race.c"]
    fields = state_sizes(inputs.own.choices.layout, inputs.own.choices.model)
    same_rate = abs(inputs.options.sample_rate / rate - 1.0) < SAME_RATE
    own = "moment_ext" in fields and same_rate and (folder / f"{name}_estimator.c").is_file()
    names += [f"{name}_estimator.c"] if own else []
    battery = HIGHEST_RPM in fields
    if battery and not same_rate:
        raise InputError(_other_rate(inputs.options.sample_rate, rate))
    names += [f"{name}_battery.c"] if battery else []
    values = {
        "fields": list(fields),
        "indiflight": indiflight,
        "own_estimator": own,
        "battery": battery,
        "motors": MOTORS,
    }
    (work / "autopilot.c").write_text(render("sil/autopilot.c", _values(inputs) | values))
    module = f"paparazzi/{name}_module.c"
    text = ", ".join(names) + (f"; without {module}" if (folder / module).is_file() else "")
    label = "INDIflight's nn_control" if indiflight else "exported C"
    label += ", its own estimator" if own else ""
    include = folder / FOLDER if indiflight else folder
    options = (f"-DNN_CONTROL_HZ={round(rate)}",) if indiflight else ()
    return Sources(tuple(folder / file for file in names), include, label, text, own, options)


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
