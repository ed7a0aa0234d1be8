"""Which autopilot can fly a policy: what it measures and takes, against what the policy needs."""

import dataclasses
from collections.abc import Collection

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.targets import (
    DEFAULT_TARGET,
    MOTOR,
    RATES,
    RPM,
    SENSORS,
    SPEEDS,
    STEP_ERROR,
    TARGETS,
    THRUST,
    Target,
    calls_per_step,
    find_target,
)
from quadjax.policy.file import Policy
from quadjax.race.layout import LAST_ACTION
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.vehicle.registry import MODELS

COMMAND_KINDS = {"rpm": RPM, "motor_command": MOTOR}  # by the name of the commands
NEEDED = {  # by field of the observation
    "rpm": (SPEEDS,),
    "rotor_speed": (SPEEDS,),
    "thrust": (THRUST,),
    HIGHEST_RPM: (SPEEDS,),
    **{name: (SPEEDS, SENSORS) for name in DISTURBANCES},
}
MOST_GATES = 255  # of INDIflight's target_gate_index, a uint8_t


def target_of(name: str, model: str) -> Target:
    """The target for a vehicle model; without an autopilot's files where it has none for it.

    Raises:
        InputError: no such target, or one whose autopilot does not take the model's commands.
    """
    target, kind = find_target(name), kind_of(model)
    if kind in target.kinds:
        return target
    if target.name == DEFAULT_TARGET:
        return dataclasses.replace(TARGETS["cortex-m7"], name=name)
    allowed = [name for name in MODELS if kind_of(name) in target.kinds]
    raise InputError(
        f"--target {name}: the policy's vehicle model is {model!r}, allowed: {', '.join(allowed)}; "
        "quadjax train e2e_race vehicle=5inch trains such a policy, and with vehicle.model=racing "
        "any vehicle file that quadjax show --write vehicle wrote"
    )


def kind_of(model: str) -> str:
    """The kind of a vehicle model's commands."""
    return COMMAND_KINDS.get(MODELS[model].commands[0].name, RATES)


def check_target(
    target: Target, policy: Policy, observed: Collection[str], gates: int, time_step: float
) -> None:
    """Check that an autopilot can fly a policy.

    Raises:
        InputError: commands out of range, a number that is not measured, too many gates, or a time
            step that is no whole number of calls.
    """
    start, low, high = f"--target {target.name}", policy.command_low, policy.command_high
    if kind_of(policy.vehicle) == MOTOR and (np.any(low < 0.0) or np.any(high > 1.0)):
        raise InputError(
            f"{start}: motor commands {low.tolist()}..{high.tolist()}, allowed: 0 to 1"
        )
    for field in observed:
        if missing := [name for name in NEEDED.get(field, ()) if name not in target.gives]:
            raise InputError(
                f"{start}: the policy observes {field}, and {target.autopilot} does not give "
                f"{' and '.join(missing)}"
            )
    if target.glue == "indiflight" and gates > MOST_GATES:
        raise InputError(f"{start}: {gates} gates, allowed: {MOST_GATES}")
    held = LAST_ACTION in policy.layout
    if target.calls and held and not calls_per_step(target.calls, time_step):
        raise InputError(
            f"{start}: the time step is {time_step:g} s, allowed: whole periods of "
            f"{target.calls:g} Hz within {STEP_ERROR:.0%}"
        )
