"""Conditions: lists of ways in which a race, a drone or a plant differs, as YAML.

A file of ``configs/conditions`` has a list ``conditions`` and how each of them is flown::

    runs: 100
    start: hover
    columns: [finished, total]
    conditions:
      - {label: as modeled}
      - {label: 4% less thrust, overrides: ["vehicle.mismatch={k_w: 0.96}"]}
      - {label: weak rotor, damage: {rotors: [0.85, 1, 1, 1]}}
      - {label: empty battery, plant: ["battery.charge=[0.2, 0.2]"]}
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from quadjax.config.assembly import vehicle_model
from quadjax.config.drone import check_drone
from quadjax.config.loading import load_config, with_track
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, prefixed
from quadjax.core.sections import (
    MAX_DRONES,
    MAX_GATES,
    MAX_LAPS,
    MAX_RUNS,
    MAX_SEED,
    Field,
    PrivateAttr,
    Section,
    load_section,
    model_validator,
    validate,
)
from quadjax.core.vectors import Rotors, Vec3
from quadjax.core.yaml_files import merge_trees, parse_overrides, parse_yaml
from quadjax.evaluation.table import COLUMNS
from quadjax.plant.config import PlantConfig, without_effects
from quadjax.vehicle import motor
from quadjax.vehicle.protocol import VehicleModel, VehicleParams
from quadjax.vehicle.rigid_body import BodyState

Start = Literal["hover", "random", "around", "before_gate"]
Factor = Annotated[float, Field(gt=0.0, le=10.0)]
Moment = Annotated[float, Field(ge=-1.0, le=1.0)]
Texts = Annotated[tuple[str, ...], Field(max_length=100)]
FOLDER, DELAYS = "conditions", "delays"
LENGTHS = ("laps", "gates", "seconds")  # of a flight: one of them


class Damage(Section):
    """Damage of a drone of the model ``motor``."""

    rotors: tuple[Factor, Factor, Factor, Factor] = Field(
        (1.0, 1.0, 1.0, 1.0), description="factor on the thrust of each rotor"
    )
    imbalance: tuple[Moment, Moment] = Field(
        (0.0, 0.0), description="kg m, mass times shift of the center of mass along body x and y"
    )


class Condition(Section):
    """One way in which the race, the simulated drone or the plant differs."""

    label: str = Field(min_length=1, description="one line")
    overrides: Texts = Field((), description="KEY=VALUE of the race's config")
    plant: Texts = Field((), description="KEY=VALUE of the plant's config")
    only: Texts | None = Field(
        None, description="the only effects of the plant that are on, or delays; null: as they are"
    )
    damage: Damage | None = Field(None, description="of the simulated drone")
    start: Start | None = Field(None, description="of the flights; null: that of the list")
    deterministic: bool | None = Field(None, description="mean actions; null: as of the list")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="added to the seed of the evaluation")

    def race(self, config: Config) -> Config:
        """The race of the condition, without its damage; see ``changed``.

        Raises:
            InputError: an unknown key or constant, or a drone that cannot fly.
        """
        with prefixed(f"condition {self.label}"):
            race = changed(config, self.overrides)
            check_drone(race)
        return race

    def on_plant(self, plant: PlantConfig | None) -> PlantConfig | None:
        """The plant of the condition; None: the simulator.

        Raises:
            InputError: an unknown key or effect, a change of the plant in the simulator, or damage
                on a plant.
        """
        with prefixed(f"condition {self.label}"):
            if plant is None:
                if self.plant or self.only is not None:
                    raise InputError("changes the plant, allowed: with a plant")
                return None
            if self.damage is not None:
                raise InputError("has damage, allowed: without a plant")
            if self.only is not None:
                plant = _with_only(plant, self.only)
            tree = merge_trees(plant.model_dump(), parse_overrides(self.plant))
            return validate(type(plant), tree, "plant") if self.plant else plant


def _with_only(plant: PlantConfig, names: Sequence[str]) -> PlantConfig:
    """A plant with the named effects only; ``DELAYS`` names its transport delays."""
    none, effects = without_effects(plant), plant.effects.model_dump()
    for name in names:
        if name not in (allowed := (*effects, DELAYS)):
            raise InputError(f"only has {name!r}, allowed: {', '.join(allowed)}")
    on = {name: effects[name] for name in names if name != DELAYS}
    delay = plant.delay if DELAYS in names else none.delay
    return none.replace(effects=none.effects.replace(**on), delay=delay)


class Conditions(Section):
    """A list of conditions, and how each of them is flown and tabulated."""

    title: str = Field("condition", description="of the column of labels")
    columns: Texts = Field(("finished", "total"), min_length=1, description="of the table, by name")
    across: bool = Field(
        False, description="a column for each condition, of the first of columns, a line per policy"
    )
    overrides: Texts = Field((), description="KEY=VALUE of the race's config, of all conditions")
    start: Start | None = Field(None, description="of the flights; null: hover")
    deterministic: bool | None = Field(None, description="mean actions; null: samples")
    runs: int | None = Field(None, ge=1, le=MAX_RUNS, description="flights; null: evaluate.runs")
    laps: int | None = Field(None, ge=1, le=MAX_LAPS, description="of a flight; null: the race's")
    gates: int | None = Field(None, ge=1, le=MAX_GATES, description="of a flight, in place of laps")
    seconds: float | None = Field(None, gt=0, le=1e4, description="of a flight, in place of laps")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="of starts, noise and disturbances")
    drawn: bool = Field(
        False,
        description="constants are drawn; populations of the model and the config's own "
        "randomization are further conditions",
    )
    tracks: bool = Field(False, description="each flight is on another random track")
    speeds: bool = Field(False, description="record the speeds of the flights")
    plant: str | None = Field(None, description="config of the plant; null: the simulator")
    drones: int | None = Field(
        None,
        ge=1,
        le=MAX_DRONES,
        description="drones of the plant, which share the flights; null: as many of its population "
        "as share them equally",
    )
    conditions: tuple[Condition, ...] = Field(min_length=1, max_length=1000, description="list")
    _source: str = PrivateAttr("conditions")  # file or name, for messages

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in self.columns:
            if name not in COLUMNS:
                raise ValueError(f"columns has {name!r}, allowed: {', '.join(COLUMNS)}")
        labels = [condition.label for condition in self.conditions]
        for label in labels:
            if labels.count(label) > 1:
                raise ValueError(f"conditions: two have the label {label!r}, allowed: one")
        lengths = [name for name in LENGTHS if getattr(self, name) is not None]
        if len(lengths) > 1:
            raise ValueError(f"{lengths[1]} is not null, allowed: one of {', '.join(LENGTHS)}")
        if self.runs is not None and self.runs % (self.drones or 1):
            raise ValueError(f"runs is {self.runs}, allowed: multiples of drones ({self.drones})")
        return self

    def resolve(self, config: Config, **arguments: object) -> Self:
        """The list with arguments that are not None; the config says what neither does.

        Raises:
            InputError: a number out of range, or arguments that exclude each other.
        """
        changes = {key: value for key, value in arguments.items() if value is not None}
        if changes.keys() & set(LENGTHS):
            changes = dict.fromkeys(LENGTHS) | changes
        elif all(getattr(self, name) is None for name in LENGTHS):
            gates = config.evaluate.gates
            changes |= {"laps": config.evaluate.laps} if gates is None else {"gates": gates}
        defaults = {"runs": config.evaluate.runs, "start": "hover", "deterministic": False}
        defaults = {key: x for key, x in defaults.items() if getattr(self, key) is None}
        return self.replace(**defaults | changes)

    def replace(self, **changes: object) -> Self:
        """A copy with other values and the same source."""
        return super().replace(**changes).set_source(self._source)

    def set_source(self, source: str) -> Self:
        """Set the file or the name with which messages begin; return the list."""
        self._source = source
        return self

    def apply(self, condition: Condition) -> Self:
        """The list with the start, the actions and the seed of one of its conditions."""
        choices = {"start": condition.start, "deterministic": condition.deterministic}
        update = {key: value for key, value in choices.items() if value is not None}
        return self.model_copy(update=update | {"seed": self.seed + condition.seed})

    def expand(
        self, config: Config, plant: PlantConfig | None = None
    ) -> Iterator[tuple[Condition, Config, PlantConfig | None]]:
        """Each condition, its race, and its plant.

        The plant is None in the simulator. In a list of several conditions it is also None for
        those that do not start from hover, which a plant cannot fly.

        Raises:
            InputError: a wrong condition; the message names the list and the condition.
        """
        with prefixed(self._source):
            races = list(self._races(config))
            for condition, race in races:
                left_out = len(races) > 1 and self.apply(condition).start != "hover"
                yield condition, race, None if plant and left_out else condition.on_plant(plant)

    def _races(self, config: Config) -> Iterator[tuple[Condition, Config]]:
        """Each condition, including those of drawn constants, and its race."""
        base = changed(config, self.overrides)
        listed = {condition.label: condition.race(base) for condition in self.conditions}
        for condition in self.conditions:
            yield condition, listed[condition.label]
        if not self.drawn:
            return
        for name in vehicle_model(base).populations:
            condition = Condition(label=name, overrides=(f"randomization={{population: {name}}}",))
            yield condition, listed.setdefault(name, condition.race(base))
        randomization = config.randomization
        if randomization.drawn and randomization.replace(tracks=None) not in [
            race.randomization for race in listed.values()
        ]:
            yield Condition(label="config"), base.replace(randomization=randomization)


def read_conditions(
    source: Conditions | Sequence[Condition] | Path | str, only: Sequence[str] | None = None
) -> Conditions:
    """Conditions of a file or of ``configs/conditions``, or those in the arguments.

    Args:
        source: a name, a YAML file, a list, or the whole.
        only: labels of some of the conditions; None: all.

    Raises:
        InputError: an unreadable file, an unknown key or label, or a value that is not allowed.
    """
    if isinstance(source, (str, Path)):
        source = load_section(Conditions, source, FOLDER).set_source(str(source))
    elif not isinstance(source, Conditions):
        source = Conditions(conditions=tuple(source))
    if only is None:
        return source
    by_label = {condition.label: condition for condition in source.conditions}
    for label in only:
        if label not in by_label:
            raise InputError(
                f"{source._source}: no condition {label!r}, allowed: {', '.join(by_label)}"
            )
    return source.replace(conditions=tuple(by_label[label] for label in only))


def changed(config: Config, overrides: Sequence[str]) -> Config:
    """A config with ``KEY=VALUE`` overrides; a value replaces the whole of what the key names.

    Raises:
        InputError: an unknown key, or a value that is not allowed.
    """
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise InputError(f"{override} is not of the form key=value")
        value = parse_yaml(text, key)
        if key == "track" and isinstance(value, str):
            config = with_track(config, value)
            continue
        if key == "vehicle" and isinstance(value, str):
            value = load_config("e2e", [override]).vehicle
        with prefixed(key):
            config = config.at(key, value)
    return config


@dataclasses.dataclass(frozen=True)
class Damaged(motor.Motor):
    """The motor-level model of a drone that is damaged or unbalanced.

    A rotor of thrust factor f has the forces and moments that one without damage has at
    ``sqrt(f)`` times its speed. The measured speeds are the true ones. A shift c of the center of
    mass adds the moment ``-c x m F`` of the specific force F.

    Attributes:
        rotors: thrust factor of each of the four rotors, above 0.
        imbalance: mass times shift of the center of mass along body x and y, kg m.
    """

    rotors: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    imbalance: tuple[float, float] = (0.0, 0.0)

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and moment, N m, body."""
        slow = Rotors(*(factor**0.5 for factor in self.rotors))
        speeds = {"actuators": body.actuators * slow, "actuator_rate": body.actuator_rate * slow}
        force, moment = super().force_moment(params, body.replace(**speeds))
        x, y = self.imbalance
        return force, moment + Vec3(-y * force.z, x * force.z, y * force.x - x * force.y)


def damaged(model: VehicleModel, damage: Damage) -> Damaged:
    """The model of a drone with damage.

    Raises:
        InputError: another model than ``motor``.
    """
    if type(model) is not motor.Motor:
        raise InputError(f"damage: the vehicle is {model.name}, allowed: motor")
    fields = {field.name: getattr(model, field.name) for field in dataclasses.fields(motor.Motor)}
    damages = {"rotors": damage.rotors, "imbalance": damage.imbalance}
    return Damaged(**fields | damages | {"disturbed": True})
