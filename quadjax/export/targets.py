"""Targets of an export: one row each, and the glue of an autopilot in ``runtime/glue``.

Every target flies the same C runtime. A row says what its autopilot measures and takes, how often
it calls the pilot, where the files go, and on which processor the verification emulates the C.
"""

import dataclasses
import math
from pathlib import Path

from quadjax.core.errors import InputError

RUNTIME = Path(__file__).parent / "runtime"
ANGLES, ROTORS = ("euler", "quaternion"), ("rotor_speed",)
SENSORS = "sensors"  # gyro, specific force and body velocity, of the estimators
EVERYTHING = (*ANGLES, *ROTORS, "rpm", "thrust", SENSORS)
ALWAYS = ("position", "velocity", "rates", "last_command")
RPM, MOTOR, RATES = 1, 2, 3  # kinds of commands
COMMAND_KINDS = {"rpm": RPM, "motor_command": MOTOR}  # by the name of the commands
STATE_FIELDS = (  # numbered from 1 on
    *("position", "velocity", "euler", "quaternion", "rates", "rotor_speed"),
    *("moment_ext", "force_ext", "last_command", "rpm", "thrust", "highest_rpm"),
)


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
    flags: tuple[str, ...] = ()  # of the compiler


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
               as_file=True, flags=("-DQJ_STATIC=1",)),
        Target("crazyflie", "Cortex-M4", "Crazyflie", "crazyflie/src", "crazyflie", ANGLES,
               (MOTOR,), 1000.0, every_call=False, flags=("-DQJ_STATIC=1",)),
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


STEP_ERROR = 0.03  # of the calls in a step of the policy, as in ``qj_pilot.c``


def calls_per_step(frequency: float, time_step: float) -> int:
    """Calls at a frequency, Hz, in a step, s; 0 where no whole number is within ``STEP_ERROR``."""
    calls = math.ceil(frequency * time_step - 0.5)  # half a call before the step it is due
    return calls if calls and abs(calls - frequency * time_step) <= STEP_ERROR * calls else 0


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
