"""The autopilots that an export is for.

Every target flies the same C runtime. A row says what its autopilot measures and takes, and how
often it calls the pilot.
"""

import dataclasses
import math
from pathlib import Path

from quadjax.core.errors import InputError

RUNTIME = Path(__file__).parent / "runtime"
RPM, MOTOR, RATES = "QJ_RPM", "QJ_MOTOR", "QJ_RATES_THRUST"  # kinds of commands
SPEEDS, THRUST, SENSORS = "rotor speeds", "specific thrust", "sensors"
EVERYTHING = (SPEEDS, THRUST, SENSORS)  # sensors: accelerometer and body velocity
STEP_ERROR = 0.03  # of the calls in a step of the policy, as in ``qj_pilot.c``


@dataclasses.dataclass(frozen=True)
class Target:
    """An autopilot whose glue is written, or a user's own firmware, which calls the pilot."""

    name: str  # as of ``quadjax export --target``
    autopilot: str  # for messages
    folder: str  # of the C in the export
    glue: str = ""  # folder of runtime/glue; "": the user's firmware calls the pilot
    gives: tuple[str, ...] = EVERYTHING  # besides position, velocity, attitude and rates
    kinds: tuple[str, ...] = (RPM, MOTOR, RATES)  # of commands that it takes
    calls: float | None = None  # of the pilot, Hz; None: as the user's firmware does


TARGETS = {
    target.name: target
    for target in (
        Target("cortex-a9", "Paparazzi", "paparazzi", "paparazzi", kinds=(RPM, RATES), calls=512.0),
        Target("cortex-m7", "your firmware", "c"),
        Target("cortex-m4", "your firmware", "c"),
        Target("indiflight", "INDIflight", "indiflight", "indiflight", (SPEEDS,), (MOTOR,), 500.0),
    )
}
DEFAULT_TARGET = "cortex-a9"


def find_target(name: str) -> Target:
    """The target of a name.

    Raises:
        InputError: no such target.
    """
    if name not in TARGETS:
        raise InputError(f"--target {name}: no such target, allowed: {', '.join(TARGETS)}")
    return TARGETS[name]


def calls_per_step(frequency: float, time_step: float) -> int:
    """Calls at a frequency, Hz, in a step, s; 0 where no whole number is within ``STEP_ERROR``."""
    calls = math.ceil(frequency * time_step - 0.5)  # half a call before the step it is due
    return calls if calls and abs(calls - frequency * time_step) <= STEP_ERROR * calls else 0


def runtime_files(target: Target) -> dict[str, str]:
    """The C runtime and the glue of a target, as they are, by path in the export."""
    files = sorted(RUNTIME.glob("qj*.[ch]"))
    if target.glue:
        files += sorted((RUNTIME / "glue" / target.glue).iterdir())
    return {f"{target.folder}/{path.name}": path.read_text("utf-8") for path in files}
