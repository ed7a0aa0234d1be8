"""Units of a race: numbers of a config in legs, in leg times and in gates.

A preset for any drone and track gives its numbers as text with a unit, such as
``learner.horizon: 1.1 leg times``. Loading replaces them by plain numbers. A field declares the
unit of its number, and takes only units of the race of the same dimension.
"""

import dataclasses
import functools
import math
import re
from typing import Any

import numpy as np

from quadjax.config.schema import Config, Rules, Vehicle
from quadjax.core.section_keys import dotted, fields_at
from quadjax.core.sections import LARGEST, BadValue, Section, refuse, unit_of, validate
from quadjax.core.yaml_files import Tree
from quadjax.race.track import TrackSection, check_lap
from quadjax.vehicle.airframe import GRAVITY_M_S2
from quadjax.vehicle.registry import base_model

LEAST_THRUST_TO_WEIGHT = 1.05  # a drone below it hardly accelerates sideways
SHORTEST_LEG_M = 0.01
ENVS_MULTIPLE = 8
Location = tuple[str | int, ...]  # of a value in a tree: keys, and indices of lists
WithUnit = dict[Location, tuple[str, float | int]]  # numbers in units of the race: text, number
_WITH_UNIT = re.compile(
    r"\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s+(?P<unit>[^\s\d].*?)\s*"
)


@dataclasses.dataclass(frozen=True)
class RaceScales:
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

    def units(self, unit: str) -> dict[str, float]:
        """The race units that a field declared in ``unit`` accepts, and their sizes in SI units.

        Environments are per leg time: their steps of an update are in leg times, so that updates of
        all races have about the same number of steps. The clip of a gradient may also be per leg
        time: lower where a leg takes longer.
        """
        per_length = {"per leg": 1.0 / self.leg, "per half gate": 1.0 / self.half_gate}
        times, per_time = {"leg times": self.time}, {"per leg time": 1.0 / self.time}
        return {
            "m": {"legs": self.leg, "half gates": self.half_gate},
            "1/m": per_length,
            "gradient": per_length | {"per leg per leg time": 1.0 / (self.leg * self.time)},
            "1/s": per_time,
            "m/s": {"legs per leg time": self.leg / self.time},
            "steps": times,
            "decay": times,
            "environments": per_time,
        }.get(unit, {})


def race_scales(track: TrackSection, vehicle: Vehicle, time_step: float) -> RaceScales:
    """The units of a race, from its track and its drone.

    The level acceleration is ``g sqrt(r^2 - 1)`` with the thrust-to-weight ratio ``r``.

    Args:
        track: its gates.
        vehicle: with the constants of its model.
        time_step: s.

    Raises:
        InputError: a vehicle model that defines no thrust-to-weight ratio, or a lap of one gate.
    """
    check_lap(track)
    model = base_model(vehicle.model)
    thrust = model.thrust_to_weight(model.make_constants(vehicle.constants))
    if thrust is None:
        allowed = "a model that has thrust_to_weight, or numbers without units of the race"
        refuse("vehicle.model", vehicle.model, allowed)
    ratio = max(float(thrust), LEAST_THRUST_TO_WEIGHT)
    centers = np.array([gate.position for gate in track.gates], np.float64)
    lengths = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    legs = lengths if track.closed else lengths[:-1]
    if len(centers) == 1:  # of a course: the way from its start
        start = centers[0] if track.start is None else track.start.position
        legs = np.linalg.norm(centers - start, axis=1)
    half_gate = 0.5 * min(size for gate in track.gates for size in gate.size)
    return RaceScales(
        leg=max(float(legs.mean()), SHORTEST_LEG_M),
        acceleration=vehicle.constants.get("g", GRAVITY_M_S2) * math.sqrt(ratio**2 - 1.0),
        half_gate=half_gate,
        time_step=time_step,
    )


def in_plain_units(tree: Tree, learner: type[Section], units_written: WithUnit) -> Tree:
    """The tree of a config with a plain number in place of each number with a unit.

    Args:
        tree: of a whole config, with a ``Vehicle`` that has its constants.
        learner: the class of its section ``learner``.
        units_written: filled with the numbers with a unit.

    Raises:
        InputError: a unit that is not one of the key's unit, or an invalid track or vehicle.
    """

    @functools.cache
    def scales() -> RaceScales:
        rules = validate(Rules, tree.get("rules", {}), "rules", "rules.")
        track = validate(TrackSection, tree.get("track", {}), "track", "track.")
        return race_scales(track, tree["vehicle"], rules.time_step)

    def convert(node: Any, location: Location) -> Any:
        if isinstance(node, dict):
            return {key: convert(value, (*location, key)) for key, value in node.items()}
        if isinstance(node, list):
            return [convert(item, (*location, index)) for index, item in enumerate(node)]
        match = _WITH_UNIT.fullmatch(node) if isinstance(node, str) else None
        unit = _unit_of(location, learner) if match else None
        if match is None or unit is None:
            return node
        value = float(match["number"]) * _size(dotted(location), match, unit, scales())
        plain = _in_unit(value, unit, scales().time_step)
        units_written[location] = (node, plain)
        return plain

    kept = ("track", "vehicle")  # which the units depend on
    return {k: x if k in kept else convert(x, (k,)) for k, x in tree.items()}


def _unit_of(location: Location, learner: type[Section]) -> str | None:
    """The unit that the field of a value declares, also of a value of its schedule."""
    if location[0] == "schedules" and location[2:3] == ("linear",):
        location = tuple(str(location[1]).split("."))
    schema: type[Section] = Config
    if location[0] == "learner":
        schema, location = learner, location[1:]
    keys = [key for key in location if isinstance(key, str)]
    field = fields_at(schema, keys[:-1]).get(keys[-1]) if keys else None
    return unit_of(field) if field else None


def _size(key: str, match: re.Match, unit: str, scales: RaceScales) -> float:
    """The size of a unit of the race, which has to be of the same dimension as the key's."""
    positive = unit in ("steps", "decay", "environments")
    number, name, units = float(match["number"]), match["unit"], scales.units(unit)
    if name not in units or abs(number) > LARGEST or (positive and number <= 0.0):
        text = f"{key} is {match['number']} {name}"[:100]
        span = f"number{' above 0' if positive else ''}, at most {LARGEST:g},"
        listed = " or ".join(units)
        raise BadValue(key, f"{text}, allowed: a plain number, or a {span} with the unit {listed}")
    return units[name]


def _in_unit(value: float, unit: str, time_step: float) -> float | int:
    """A number in SI units, converted to the unit of its field."""
    if unit == "steps":
        return max(1, round(value / time_step))
    if unit == "decay":
        return math.exp(-time_step / value)
    if unit == "environments":
        return max(ENVS_MULTIPLE, ENVS_MULTIPLE * round(value / ENVS_MULTIPLE))
    return value
