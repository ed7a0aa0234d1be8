"""Targets of an export: one row each, and the glue of an autopilot in ``runtime/glue``.

Every target flies the same C runtime. A row says what its autopilot measures and takes, how often
it calls the pilot, and where the files go.
"""

import dataclasses
import math
from pathlib import Path

from quadjax.core.errors import InputError

RUNTIME = Path(__file__).parent / "runtime"
ANGLES, ROTORS = ("euler", "quaternion"), ("rotor_speed",)
SENSORS = "sensors"  # gyro, specific force and body velocity, of the estimators
EVERYTHING = (*ANGLES, *ROTORS, "rpm", "thrust", SENSORS)
RPM, MOTOR, RATES = 1, 2, 3  # kinds of commands
COMMAND_KINDS = {"rpm": RPM, "motor_command": MOTOR}  # by the name of the commands
STATE_FIELDS = (  # numbered from 1 on
    *("position", "velocity", "euler", "quaternion", "rates", "rotor_speed"),
    *("moment_ext", "force_ext", "last_command", "rpm", "thrust", "highest_rpm"),
)


@dataclasses.dataclass(frozen=True)
class Target:
    """An autopilot whose files are written, or a processor for which a user's firmware is built."""

    name: str  # as of ``quadjax export --target``
    autopilot: str  # for messages
    folder: str  # of the C in the export
    glue: str = ""  # folder of runtime/glue; "": the user's firmware calls the pilot
    gives: tuple[str, ...] = EVERYTHING  # what it measures besides position, velocity and rates
    kinds: tuple[int, ...] = (RPM, MOTOR, RATES)  # of commands that it takes
    calls: float | None = None  # of the pilot, Hz; None: one call a step of the policy
    as_file: bool = False  # the policy is NAME.qjp; else the table of NAME.h


BEBOP = (*ANGLES, "rpm", "thrust", SENSORS)
TARGETS = {
    target.name: target
    for target in (
        Target("cortex-a9", "Paparazzi", "paparazzi", "paparazzi", BEBOP, (RPM, RATES), 512.0),
        Target("cortex-m7", "your firmware", "c"),
        Target("cortex-m4", "your firmware", "c"),
        Target("indiflight", "INDIflight", "indiflight", "indiflight",
               (*ANGLES, *ROTORS), (MOTOR,), 500.0),
        Target("qjp", "your firmware", "qjp", as_file=True),
    )
}  # fmt: skip
DEFAULT_TARGET = "cortex-a9"
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
    files = [path for path in sorted(RUNTIME.glob("qj*.[ch]")) if path.name != "qj_sizes.h"]
    if target.glue:
        files += sorted((RUNTIME / "glue" / target.glue).iterdir())
    return {f"{target.folder}/{path.name}": path.read_text("utf-8") for path in files}
