"""Targets of an export: one row each, and the glue of an autopilot in ``runtime/glue``.

Every target flies the same C runtime. A row says what its autopilot measures and takes, how often
it calls the pilot, where the files go, and on which processor the verification emulates the C.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.network import FixedNetwork
from quadjax.export.race_tables import RaceTables
from quadjax.export.words import COMMAND_KINDS, OTHER_COMMANDS, STATE_FIELDS
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.vehicle.registry import MODELS

RUNTIME = Path(__file__).parent / "runtime"
ANGLES, ROTORS = ("euler", "quaternion"), ("rotor_speed",)
SENSORS = "sensors"  # gyro, specific force and body velocity, of the estimators
EVERYTHING = (*ANGLES, *ROTORS, "rpm", "thrust", SENSORS)
ALWAYS = ("position", "velocity", "rates", "last_command")
RPM, MOTOR, RATES = COMMAND_KINDS["rpm"], COMMAND_KINDS["motor_command"], OTHER_COMMANDS


@dataclasses.dataclass(frozen=True)
class Target:
    """A processor, and the autopilot whose files are written."""

    name: str  # as of ``quadjax export --target``
    processor: str
    autopilot: str  # for messages
    folder: str  # of the C in the export
    glue: str = ""  # folder of runtime/glue; "": the user's firmware calls the pilot
    gives: tuple[str, ...] = EVERYTHING  # what it measures besides position, velocity and rates
    kinds: tuple[int, ...] = (RPM, MOTOR, RATES)  # of commands that it takes
    calls: float | None = None  # of the pilot, Hz; None: one call a step of the policy
    every_call: bool = True  # a policy that observes no earlier step runs at every call
    as_file: bool = False  # the policy is NAME.qjp; else the table of NAME.h


PX4_MODULE = "px4/src/modules/quadjax_policy"  # in EXTERNAL_MODULES_LOCATION
BEBOP = (*ANGLES, "rpm", "thrust", SENSORS)
TARGETS = {
    target.name: target
    for target in (
        Target("cortex-a9", "Cortex-A9", "Paparazzi", "paparazzi", "paparazzi", BEBOP,
               (RPM, RATES), 512.0),
        Target("cortex-m7", "Cortex-M7", "your firmware", "c"),
        Target("cortex-m4", "Cortex-M4", "your firmware", "c"),
        Target("indiflight", "Cortex-M7", "INDIflight", "indiflight", "indiflight",
               (*ANGLES, *ROTORS), (MOTOR,), 500.0),
        Target("qjp", "Cortex-M7", "your firmware", "qjp", as_file=True),
        Target("px4", "Cortex-M7", "PX4", PX4_MODULE, "px4", (*ANGLES, *ROTORS), (MOTOR,),
               as_file=True),
        Target("crazyflie", "Cortex-M4", "Crazyflie", "crazyflie/src", "crazyflie", ANGLES,
               (MOTOR,), 1000.0, every_call=False),
    )
}  # fmt: skip
DEFAULT_TARGET = "cortex-a9"
PLACES = {  # of glue files that do not lie next to the runtime
    "crazyflie": {"Kbuild": "..", "Makefile": "..", "app-config": ".."},
}
RENAMED = {"src_Kbuild": "Kbuild"}
MOST_GATES = 255  # of INDIflight's target_gate_index, a uint8_t


def find_target(name: str) -> Target:
    """The target of a name.

    Raises:
        InputError: no such target.
    """
    if name not in TARGETS:
        raise InputError(f"--target {name}: no such target, allowed: {', '.join(TARGETS)}")
    return TARGETS[name]


def target_of(name: str, model: str) -> Target:
    """The target for a vehicle model; without an autopilot's files where it has none for it.

    Raises:
        InputError: no such target, or one whose autopilot does not take the model's commands.
    """
    target, kind = find_target(name), kind_of(model)
    if kind in target.kinds:
        return target
    if target.name == DEFAULT_TARGET:
        return dataclasses.replace(TARGETS["cortex-m7"], name=name, processor=target.processor)
    allowed = [own for own in MODELS if kind_of(own) in target.kinds]
    raise InputError(
        f"--target {name}: the policy's vehicle model is {model!r}, allowed: {', '.join(allowed)}; "
        "quadjax train e2e vehicle=5inch trains such a policy"
    )


def kind_of(model: str) -> int:
    """The kind of a vehicle model's commands."""
    return COMMAND_KINDS.get(MODELS[model].commands[0].name, OTHER_COMMANDS)


def observed_fields(race: RaceTables) -> set[str]:
    """The fields of the state that an observation is computed from, but for those seen as zero."""
    sources = {
        source
        for part in race.inputs
        if part.kind != "gate"
        for source, own in zip(part.sources, part.rescales or (True,) * 4, strict=False)
        if own is not None
    }
    return {
        name
        for name, start in race.starts.items()
        if sources & set(range(start, start + len(race.fields[name])))
    }


def check_target(target: Target, network: FixedNetwork, race: RaceTables) -> None:
    """Check that an autopilot can fly a policy; the pilot on board checks the same.

    Raises:
        InputError: commands out of range, a number that is not measured, too many gates, or a time
            step that is no whole number of calls.
    """
    start, unit = f"--target {target.name}", 2.0**network.fraction_bits
    low, high = network.command_low / unit, network.command_high / unit
    if kind_of(network.model.name) == MOTOR and (np.any(low < 0.0) or np.any(high > 1.0)):
        raise InputError(
            f"{start}: motor commands {low.tolist()}..{high.tolist()}, allowed: 0 to 1"
        )
    gives = {*ALWAYS, *target.gives}
    if {SENSORS, "rpm"} <= gives:
        gives |= {*DISTURBANCES, HIGHEST_RPM}
    for name in sorted(observed_fields(race) - gives):
        hint = ""
        if name in ROTORS:
            hint = "; train with observation.actuators=false observation.last_action=true"
        raise InputError(
            f"{start}: the policy observes {name}, which {target.autopilot} does not give{hint}"
        )
    if target.name == "indiflight" and race.gates > MOST_GATES:
        raise InputError(f"{start}: {race.gates} gates, allowed: {MOST_GATES}")
    held = race.box.layout.counts_steps or not target.every_call
    if target.name == "crazyflie" and round(1e9 * race.time_step) % 1_000_000:
        raise InputError(
            f"{start}: the time step is {race.time_step:g} s, allowed: whole milliseconds"
        )
    if target.calls and held and not calls_per_step(target.calls, race.time_step):
        raise InputError(
            f"{start}: the time step is {race.time_step:g} s, allowed: whole periods of "
            f"{target.calls:g} Hz within {STEP_ERROR:.0%}"
        )


STEP_ERROR = 0.03  # of the calls in a step of the policy, as in ``qj_pilot.c``


def calls_per_step(frequency: float, time_step: float) -> int:
    """Calls at a frequency, Hz, in a step, s; 0 where no whole number is within ``STEP_ERROR``."""
    calls = math.ceil(frequency * time_step - 0.5)  # half a call before the step it is due
    return calls if calls and abs(calls - frequency * time_step) <= STEP_ERROR * calls else 0


def pilot_options(target: Target, call_ns: int, disturbances: bool = False) -> list[str]:
    """Compiler options: the interface of a target's autopilot, for C that stands in for it.

    Args:
        target: the target.
        call_ns: between two calls of the pilot.
        disturbances: external moment and force are given too.
    """
    names = [*target.gives, *(DISTURBANCES if disturbances else ())]
    bits = sum(
        1 << (16 if name == SENSORS else 1 + STATE_FIELDS.index(name)) for name in set(names)
    )
    kinds = sum(1 << kind for kind in target.kinds)
    values = {"GIVES": bits, "KINDS": kinds, "CALL_NS": call_ns}
    values["EVERY_CALL"] = int(target.every_call)
    return [f"-DINTERFACE_{name}={value}U" for name, value in values.items()]


def runtime_files(target: Target) -> dict[str, str]:
    """The C runtime and the glue of a target, as they are, by path in the export."""
    files = {path.name: path for path in sorted(RUNTIME.glob("qj*.[ch]"))}
    del files["qj_sizes.h"]  # an export has its own
    if target.glue:
        places = PLACES.get(target.glue, {})
        for path in sorted((RUNTIME / "glue" / target.glue).iterdir()):
            name = RENAMED.get(path.name, path.name)
            files["../" + name if path.name in places else name] = path
    return {
        (Path(target.folder) / name).as_posix().replace("/src/..", ""): path.read_text("utf-8")
        for name, path in files.items()
    }


def sources_of(target: Target) -> list[str]:
    """The C files of the runtime in the export of a target; that of angles is for glue alone."""
    names = sorted(path.name for path in RUNTIME.glob("qj_*.c"))
    return [f"{target.folder}/{name}" for name in names if name != "qj_angles.c"]
