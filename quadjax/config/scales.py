"""Units of a race: numbers of a config in legs, in leg times and in gates.

A preset for any drone and track gives its numbers as text with a unit, such as
``learner.horizon: 1.1 leg times``. Loading replaces them by plain numbers.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from quadjax.config.schema import Rules, Track, Vehicle
from quadjax.core.errors import InputError
from quadjax.core.sections import build
from quadjax.core.yaml_files import Tree
from quadjax.vehicle.registry import model as vehicle_model

GRAVITY = 9.81
LEAST_RATIO = 1.05  # of thrust to weight: a drone below it hardly accelerates sideways
SHORTEST = 0.01  # m, of a leg
STEPS = ("learner.horizon", "learner.rollout_length", "training_limits.episode_steps")
DECAYS = ("learner.discount", "learner.cotangent_decay")  # per step
ENVS = "learner.num_envs"  # times learner.horizon: the same number of steps in every race
ENVS_MULTIPLE = 8
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


@dataclasses.dataclass(frozen=True)
class Scales:
    """The units of a race.

    Attributes:
        leg: mean distance between the centers of consecutive gates, m.
        acceleration: largest level acceleration of the drone, m/s^2.
        half_gate: half of the smallest width or height of an opening, m.
        time_step: s.
    """

    leg: float
    acceleration: float
    half_gate: float
    time_step: float

    @property
    def time(self) -> float:
        """The leg time, s: in it, the drone accelerates from rest over half a leg."""
        return math.sqrt(self.leg / self.acceleration)


UNITS: dict[str, Callable[[Scales], float]] = {
    "legs": lambda s: s.leg,
    "per leg": lambda s: 1.0 / s.leg,
    "leg times": lambda s: s.time,
    "per leg time": lambda s: 1.0 / s.time,
    "legs per leg time": lambda s: s.leg / s.time,
    "half gates": lambda s: s.half_gate,
    "per half gate": lambda s: 1.0 / s.half_gate,
}
_WITH_UNIT = re.compile(rf"\s*({_NUMBER})\s+({'|'.join(sorted(UNITS, key=len, reverse=True))})\s*")


def race_scales(track: Track, vehicle: Vehicle, time_step: float) -> Scales:
    """The units of a race, from its track and its drone.

    The level acceleration is ``g sqrt(r^2 - 1)`` with the thrust-to-weight ratio ``r``.

    Args:
        track: its gates.
        vehicle: with the constants of its model.
        time_step: s.

    Raises:
        InputError: a vehicle model that defines no thrust-to-weight ratio.
    """
    model = vehicle_model(vehicle.model)
    if model.thrust_to_weight is None:
        raise InputError(
            f"vehicle.model is {vehicle.model}, which has no thrust_to_weight; allowed: one that "
            f"has, or values without the units {', '.join(UNITS)}"
        )
    ratio = max(float(model.thrust_to_weight(vehicle.constants)), LEAST_RATIO)
    centers = np.array([gate.position for gate in track.gates], np.float64)
    lengths = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    legs = lengths if track.closed or len(lengths) == 1 else lengths[:-1]
    half_gate = 0.5 * min(size for gate in track.gates for size in gate.size)
    return Scales(
        leg=max(float(legs.mean()), SHORTEST),
        acceleration=vehicle.constants.get("g", GRAVITY) * math.sqrt(ratio**2 - 1.0),
        half_gate=half_gate,
        time_step=time_step,
    )


def in_plain_units(tree: Tree) -> Tree:
    """The tree of a config with a plain number in place of each number with a unit.

    Args:
        tree: of a whole config, with the constants of the vehicle.

    Raises:
        InputError: a unit with a key that has none, or an invalid track or vehicle.
    """
    scales: list[Scales] = []

    def convert(node: Any, key: str) -> Any:
        if isinstance(node, dict):
            return {k: convert(v, f"{key}.{k}" if key else k) for k, v in node.items()}
        if isinstance(node, list):
            return [convert(item, key) for item in node]
        found = _WITH_UNIT.fullmatch(node) if isinstance(node, str) else None
        if found is None:
            return node
        if not scales:
            scales.append(_scales_of(tree))
        return _plain(key, float(found[1]), found[2], scales[0])

    converted = {k: convert(v, k) for k, v in tree.items() if k not in ("track", "vehicle")}
    return {**tree, **converted}


def _scales_of(tree: Tree) -> Scales:
    rules = build(Rules, tree.get("rules", {}), "rules", "rules.")
    track = build(Track, tree.get("track", {}), "track", "track.")
    vehicle = build(Vehicle, tree["vehicle"], "vehicle", "vehicle.")
    return race_scales(track, vehicle, rules.time_step)


def _plain(key: str, number: float, unit: str, scales: Scales) -> float | int:
    """A number with a unit, converted to the unit of its key."""
    key = key.removeprefix("schedules.").removesuffix(".linear")
    value = number * UNITS[unit](scales)
    if key in STEPS + DECAYS:
        if unit != "leg times" or value <= 0:
            raise InputError(f"{key} is {number:g} {unit}, allowed: a number of leg times above 0")
        steps = value / scales.time_step
        return math.exp(-1.0 / steps) if key in DECAYS else max(1, round(steps))
    if key == ENVS:
        if unit != "per leg time" or value <= 0:
            raise InputError(f"{key} is {number:g} {unit}, allowed: a number per leg time above 0")
        return max(ENVS_MULTIPLE, ENVS_MULTIPLE * round(value / ENVS_MULTIPLE))
    return value
