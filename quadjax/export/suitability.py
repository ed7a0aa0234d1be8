"""Which autopilot can fly a policy: what it takes, against what the policy commands and needs."""

import dataclasses

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.network import FixedNetwork
from quadjax.export.race_tables import RaceTables
from quadjax.export.targets import (
    COMMAND_KINDS,
    DEFAULT_TARGET,
    MOST_GATES,
    MOTOR,
    RATES,
    STEP_ERROR,
    TARGETS,
    Target,
    calls_per_step,
    find_target,
)
from quadjax.race.layout import LAST_ACTION
from quadjax.vehicle.registry import MODELS


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


def kind_of(model: str) -> int:
    """The kind of a vehicle model's commands."""
    return COMMAND_KINDS.get(MODELS[model].commands[0].name, RATES)


def observed_fields(race: RaceTables) -> set[str]:
    """The fields of the state from which an observation is computed, without those seen as zero."""
    sources: set[int] = set()
    for part in (part for part in race.inputs if part.kind != "gate"):
        seen = part.sources
        sources |= set(
            (seen[part.numbers["factor"] != 0] if part.kind == "scaled" else seen).tolist()
        )
    return {
        name
        for name, start in race.starts.items()
        if sources & set(range(start, start + len(race.fields[name])))
    }


def check_target(target: Target, network: FixedNetwork, race: RaceTables) -> None:
    """Check that an autopilot can fly a policy; the pilot on board checks the same.

    Raises:
        InputError: commands out of range, too many gates, or a time step that is no whole number of
            calls.
    """
    start, unit = f"--target {target.name}", 2.0**network.fraction_bits
    low, high = network.command_low / unit, network.command_high / unit
    if kind_of(network.model.name) == MOTOR and (np.any(low < 0.0) or np.any(high > 1.0)):
        raise InputError(
            f"{start}: motor commands {low.tolist()}..{high.tolist()}, allowed: 0 to 1"
        )
    if target.name == "indiflight" and race.gates > MOST_GATES:
        raise InputError(f"{start}: {race.gates} gates, allowed: {MOST_GATES}")
    held = LAST_ACTION in race.box.layout
    if target.calls and held and not calls_per_step(target.calls, race.time_step):
        raise InputError(
            f"{start}: the time step is {race.time_step:g} s, allowed: whole periods of "
            f"{target.calls:g} Hz within {STEP_ERROR:.0%}"
        )
