"""A sweep: the search space, and the check that every trial can run."""

import dataclasses
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, prefixed
from quadjax.core.resources import find_file
from quadjax.core.sections import Section, build, value_at
from quadjax.core.yaml_files import flatten, merge_trees, override, parse_overrides, read_yaml
from quadjax.plant.config import load_plant_config
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.schema import ENTRIES, MAX_TRIALS, Range, SweepFile

Plain = bool | int | float | str | None  # a value as Optuna stores it: lists as JSON text
Params = dict[str, Plain]
Interval = optuna.distributions.FloatDistribution | optuna.distributions.IntDistribution

OWN_KEYS = ("name", "seed", "run.devices", "run.tensorboard")  # set by the sweep
RACE = ("vehicle", "track", "rules", "randomization", "disturbance", "start", "evaluate")
TRIALS = 20  # of a sweep without a budget
COMBINATIONS = 64  # combinations of the space's ends that are all checked


@dataclasses.dataclass(frozen=True)
class Dimension:
    """One key of the config with its values: ``choices``, or an interval of numbers."""

    key: str  # dotted
    given: Range
    choices: tuple[Plain, ...] = ()
    interval: Interval | None = None

    def suggest(self, trial: optuna.Trial) -> Plain:
        """The value of a trial."""
        if self.interval is None:
            return trial.suggest_categorical(self.key, self.choices)
        x = self.interval
        if isinstance(x, optuna.distributions.IntDistribution):
            return trial.suggest_int(self.key, x.low, x.high, step=x.step, log=x.log)
        return trial.suggest_float(self.key, x.low, x.high, step=x.step, log=x.log)

    def override(self, value: Plain) -> str:
        """The ``key=value`` override of a stored value."""
        written = self.given.choices
        return override(self.key, written[self.choices.index(value)] if written else value)

    def ends(self) -> list[Plain]:
        """All choices, or both ends of an interval."""
        return [self.interval.low, self.interval.high] if self.interval else [*self.choices]

    def contains(self, value: Plain) -> bool:
        """Whether a value is one of the choices, or in the interval."""
        if self.interval is None:
            return value in self.choices
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return False
        return self.interval.low <= value <= self.interval.high

    @property
    def size(self) -> float:
        """The number of values; infinite for a continuous interval."""
        x = self.interval
        if x is None:
            return len(self.choices)
        return math.inf if x.step is None else round((x.high - x.low) / x.step) + 1

    def grid(self) -> list[Plain]:
        """Every value of a grid; ``InputError`` for an interval without ``step`` or ``points``."""
        x, points = self.interval, self.given.points
        if x is None:
            return [*self.choices]
        if points:
            spaced = np.geomspace if x.log else np.linspace
            values = [x.low, *spaced(x.low, x.high, points)[1:-1].tolist(), x.high]
        elif x.step is not None and not x.log:
            step = max(x.step, (x.high - x.low) / 1e6)
            values = np.arange(x.low, x.high + 0.5 * step, step).tolist()
        else:
            raise InputError(f"space.{self.key}: a grid needs choices, step or points")
        return sorted({round(v) for v in values}) if isinstance(x.low, int) else values


def plain(value: Any) -> Plain:
    """A config's value as Optuna stores it."""
    return json.dumps(value) if isinstance(value, (list, tuple, dict)) else value


def read_dimension(key: str, given: object, config: Section) -> Dimension:
    """A dimension of a sweep file's ``space``; the base config tells the type of its key."""
    kinds = optuna.distributions
    with prefixed(f"space.{key}"):
        if key in OWN_KEYS:
            raise ValueError(f"{key} is set by the sweep")
        base = value_at(config, key)
        if not isinstance(given, dict):
            raise ValueError(f"{given!r}, allowed: a mapping with choices, range or log")
        known = build(Range, given, "values")
        if known.choices is not None:
            return Dimension(key, known, tuple(map(plain, known.choices)))
        if isinstance(base, bool) or not isinstance(base, (int, float, type(None))):
            raise ValueError("is not a number, allowed: choices")
        (low, high), step, log = known.bounds, known.step, known.log is not None
        whole = all(number.is_integer() for number in (low, high, step or 1.0))
        if isinstance(base, int) and not whole:
            raise ValueError(f"expected whole numbers, found {given}")
        if isinstance(base, float) or not whole:
            return Dimension(key, known, interval=kinds.FloatDistribution(low, high, log, step))
        numbers = kinds.IntDistribution(int(low), int(high), log, int(step or 1))
        return Dimension(key, known, interval=numbers)


def draws(
    dimensions: Sequence[Dimension], count: int, seed: int, first: Sequence[Params] = ()
) -> list[Params]:
    """Random parameters after the ``first`` ones, up to ``count``.

    All differ until the space has no others. The first ones of a longer list are the same.
    """
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    size, found = size_of(dimensions), [*first]
    seen = {tuple(x.values()) for x in first}
    while len(found) < count:
        trial = study.ask()
        params = {d.key: d.suggest(trial) for d in dimensions}
        key = tuple(params.values())
        if key not in seen or len(seen) >= size:
            found.append(params)
            seen.add(key)
    return found


def size_of(dimensions: Sequence[Dimension]) -> float:
    """The number of points of a search space; infinite where a key is continuous."""
    return math.prod(d.size for d in dimensions)


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A checked sweep."""

    file: SweepFile
    base: Path  # the base config
    overrides: tuple[str, ...]  # changes to it, the same for every trial
    dimensions: tuple[Dimension, ...]
    trials: int  # the budget
    conditions: tuple[str, ...]  # overrides: the race in which every policy is evaluated

    def config_of(self, params: Params, *more: str) -> Config:
        """A trial's config with more overrides; ``InputError`` if they do not go together."""
        own = [d.override(params[d.key]) for d in self.dimensions]
        return load_config(self.base, [*self.overrides, *own, *more])

    def queue(self) -> list[Params]:
        """Parameters of all trials, whatever order they end in; empty where TPE chooses them."""
        search = self.file.search
        if search.method == "grid":
            points = itertools.product(*(d.grid() for d in self.dimensions))
            return [dict(zip(self.keys, point, strict=True)) for point in points]
        count = self.trials if search.method == "random" else min(search.startup, self.trials)
        first = []
        if search.base_first:
            config = load_config(self.base, self.overrides)
            first = [{d.key: plain(value_at(config, d.key)) for d in self.dimensions}]
        drawn = draws(self.dimensions, count, search.seed, first)
        return [*drawn, *({} for _ in range(self.trials - count))]

    @property
    def keys(self) -> list[str]:
        """The keys of the space."""
        return [d.key for d in self.dimensions]

    def definition(self) -> dict[str, str]:
        """The settings that trials of one study must share, by dotted key."""
        parts = {
            "search": self.file.search.model_dump(),
            "objective": self.file.objective.model_dump(),
            "conditions": list(self.conditions),
            "space": {d.key: d.given.model_dump(exclude_none=True) for d in self.dimensions},
            "config": load_config(self.base, self.overrides).model_dump(mode="json", by_alias=True),
        }
        return {key: json.dumps(value) for key, value in flatten(parts, ENTRIES).items()}


def load_sweep(path: Path | str, overrides: Sequence[str] = ()) -> Sweep:
    """The sweep of a YAML file and ``key=value`` overrides, checked before anything is trained."""
    path = Path(path)
    trees = [read_yaml(path), parse_overrides(overrides)]
    for tree in trees:
        if isinstance(tree.get("space"), dict):
            tree["space"] = flatten(tree["space"], ENTRIES)
    file = build(SweepFile, merge_trees(*trees), str(path))
    with prefixed(str(path)):
        return _checked(file, path.parent)


def _checked(file: SweepFile, folder: Path) -> Sweep:
    name, *parts = file.config.split(" +")
    base = find_file(name, [folder])
    fixed = tuple(override(key, value) for key, value in file.overrides.items())
    fixed = (*(f"+{part}" for part in parts), *fixed)
    config = load_config(base, fixed)
    dimensions = tuple(read_dimension(key, given, config) for key, given in file.space.items())
    race = {d.key: value_at(config, d.key) for d in dimensions if d.key.split(".")[0] in RACE}
    race.pop("vehicle.model", None)
    conditions = tuple(override(k, v) for k, v in (race | file.conditions).items())
    load_config(base, (*fixed, *conditions))
    _check_plant(file, config)
    sweep = Sweep(file, base, fixed, dimensions, _trials(file, dimensions), conditions)
    for d in dimensions if file.search.base_first else ():
        first = plain(value_at(config, d.key))
        if not d.contains(first):
            raise InputError(f"space.{d.key}: search.base_first needs the base's {first} in it")
    _check_values(sweep)
    size = size_of(dimensions)
    if file.search.method == "random" and sweep.trials > size:
        most = f"{size:.0f}, the number of points of the space"
        raise InputError(f"budget.trials is {sweep.trials}, allowed: at most {most}")
    return sweep


def _trials(file: SweepFile, dimensions: Sequence[Dimension]) -> int:
    """The budget, or all points of a grid or of a small space that is searched at random."""
    given, size = file.budget.trials, size_of(dimensions)
    if file.search.method == "grid":
        points = math.prod(len(d.grid()) for d in dimensions)
        most = given or MAX_TRIALS
        if points > most:
            raise InputError(f"the grid has {points} points, allowed by budget.trials: {most}")
        return points
    if file.search.method == "tpe":
        return given or TRIALS
    return given or int(min(TRIALS, size))


def _check_plant(file: SweepFile, config: Config) -> None:
    """Refuse keys without effect for an objective on the plant, or without one."""
    plant, plants = file.objective.plant, file.objective.plants
    if plant is None:
        if plants != type(file.objective).model_fields["plants"].default:
            raise InputError(f"objective.plants is {plants}, allowed: only with objective.plant")
        return
    load_plant_config(plant)
    if file.conditions:
        raise InputError("conditions: allowed: none with objective.plant")
    if config.evaluate.gates is not None:
        raise InputError("evaluate.gates: allowed: null with objective.plant")
    if file.objective.runs % plants:
        raise InputError(
            f"objective.runs is {file.objective.runs}, allowed: a multiple of objective.plants, "
            f"{plants}"
        )


def _check_values(sweep: Sweep) -> None:
    """Try combinations of the ends of all ranges: all, or each end with random other values."""
    ends = [d.ends() for d in sweep.dimensions]
    if math.prod(map(len, ends)) <= COMBINATIONS:
        tried = [dict(zip(sweep.keys, x, strict=True)) for x in itertools.product(*ends)]
    else:
        alone = [{d.key: x} for d in sweep.dimensions for x in d.ends()]
        tried = [a | b for a, b in zip(draws(sweep.dimensions, len(alone), 0), alone, strict=True)]
    for params in tried:
        shown = ", ".join(d.override(params[d.key]) for d in sweep.dimensions)
        with prefixed(f"space: {shown}"):
            sweep.config_of(params)
