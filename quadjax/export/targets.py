"""Targets of an export: the processor that the C runs on, and the autopilot whose files it gets.

The network, the observation and the estimator are the same C for every target. A target adds the
files of an autopilot, and says on which processor the verification emulates the C.
"""

import dataclasses

from quadjax.core.errors import InputError

PAPARAZZI, INDIFLIGHT = "Paparazzi", "INDIflight"
PX4, CRAZYFLIE = "PX4", "Crazyflie"
QJP = ".qjp"  # any autopilot that loads the policy as a file


@dataclasses.dataclass(frozen=True)
class Target:
    """A processor, and the autopilot whose files are written."""

    name: str  # as of ``quadjax export --target``
    processor: str  # as in the names of the checks
    autopilot: str | None  # None: no files but those that every autopilot can use


AS_FILE = (QJP, PX4, CRAZYFLIE)  # autopilots that load NAME.qjp
TARGETS = {
    target.name: target
    for target in (
        Target("cortex-a9", "Cortex-A9", PAPARAZZI),
        Target("cortex-m7", "Cortex-M7", None),
        Target("cortex-m4", "Cortex-M4", None),
        Target("indiflight", "Cortex-M7", INDIFLIGHT),
        Target("qjp", "Cortex-M7", QJP),
        Target("px4", "Cortex-M7", PX4),
        Target("crazyflie", "Cortex-M4", CRAZYFLIE),
    )
}
DEFAULT_TARGET = "cortex-a9"
MOTOR_MODELS = ("racing", "a2rl")  # vehicle models whose commands are 0 to 1
MOTOR_TARGETS = ("indiflight", "px4", "crazyflie")  # whose autopilots take motor commands


def check_model(target: str, model: str) -> None:
    """Check that a target's autopilot takes the commands of a vehicle model.

    Raises:
        InputError: another vehicle model than those with motor commands.
    """
    if target in MOTOR_TARGETS and model not in MOTOR_MODELS:
        raise InputError(
            f"--target {target}: the policy's vehicle model is {model!r}, allowed: "
            f"{', '.join(MOTOR_MODELS)}, whose motor commands are 0 to 1"
        )


def has_estimator(target: str) -> bool:
    """Whether an export for a target has the disturbance estimator's C: a file has none."""
    return TARGETS[target].autopilot not in AS_FILE


def find_target(name: str) -> Target:
    """The target of a name.

    Raises:
        InputError: no such target.
    """
    if name not in TARGETS:
        raise InputError(f"--target {name}: no such target, allowed: {', '.join(TARGETS)}")
    return TARGETS[name]
