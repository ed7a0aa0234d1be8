"""Sweep files: the keys, the search space, and the check that every trial can run."""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, prefixed
from quadjax.core.resources import find_file
from quadjax.core.secrets import DATABASE
from quadjax.core.sections import (
    Field,
    FolderName,
    Positive,
    Section,
    build,
    model_validator,
    value_at,
)
from quadjax.core.yaml_files import flatten, merge_trees, override, parse_overrides, read_yaml
from quadjax.plant.config import load_plant_config

ENTRIES = ("choices", "range", "log", "step", "points")  # of a key of the search space
MAX_TRIALS = 10_000
TRIALS = 20  # of a sweep without a budget
COMBINATIONS = 64  # combinations of the space's ends that are all checked
SET_BY_SWEEP = ("name", "seed", "run.devices", "run.tensorboard")
RACE = ("vehicle", "track", "rules", "randomization", "disturbance", "start", "evaluate")
Value = bool | int | float | str | None  # as Optuna stores it: lists as JSON text
Params = dict[str, Value]
Distribution = CategoricalDistribution | FloatDistribution | IntDistribution


class Range(Section):
    """The values of one key: exactly one of ``choices``, ``range`` and ``log``."""

    choices: tuple[Any, ...] | None = Field(
        None, min_length=1, max_length=1000, description="values"
    )
    range: tuple[float, float] | None = Field(None, description="lowest and highest value")
    log: tuple[float, float] | None = Field(None, description="the same, on a log scale")
    step: Positive | None = Field(None, description="distance of the values of a range")
    points: int | None = Field(None, ge=2, le=MAX_TRIALS, description="number of values of a grid")

    @model_validator(mode="after")
    def _check(self) -> "Range":
        ways = [way for way in ENTRIES[:3] if getattr(self, way) is not None]
        if len(ways) != 1:
            raise ValueError(f"expected one of choices, range and log, found {len(ways)}")
        texts = [json.dumps(choice) for choice in self.choices or []]
        if twice := [text for text in texts if texts.count(text) > 1]:
            raise ValueError(f"the choice {twice[0]} is there twice")
        if self.step and (self.range is None or self.points):
            raise ValueError(f"step is {self.step:g}, allowed: with range, without points")
        return self

    def distribution(self, base: object) -> Distribution:
        """Optuna's, of a key whose value in the base config is ``base``; ``ValueError``."""
        if self.choices is not None:
            return CategoricalDistribution([stored(choice) for choice in self.choices])
        if isinstance(base, bool) or not isinstance(base, (int, float, type(None))):
            raise ValueError("is not a number, allowed: choices")
        low, high = self.range or self.log or (0.0, 1.0)
        whole = all(number.is_integer() for number in (low, high, self.step or 1.0))
        if isinstance(base, int) and not whole:
            raise ValueError(f"{[low, high]} with step {self.step}, allowed: whole numbers")
        if isinstance(base, float) or not whole:
            return FloatDistribution(low, high, self.log is not None, self.step)
        return IntDistribution(int(low), int(high), self.log is not None, int(self.step or 1))


class Search(Section):
    """How the space is searched."""

    method: Literal["tpe", "random", "grid"] = Field("tpe", description="Optuna's sampler")
    seed: int = Field(0, ge=0, lt=2**31, description="seed of the sampler")
    base_first: bool = Field(False, description="the first trial is the base config")
    startup: int = Field(10, ge=1, le=MAX_TRIALS, description="random trials before TPE starts")
    pruner: Literal["none", "median", "halving"] = Field("none", description="stops bad trials")
    pruner_startup: int = Field(5, ge=0, le=MAX_TRIALS, description="trials before any is pruned")


class Objective(Section):
    """The value of a trial: the median of the lap times over its seeds; lower is better."""

    seeds: int = Field(3, ge=1, le=1000, description="trainings of a trial, from seed 0")
    runs: int = Field(16, ge=1, le=100_000, description="timed runs from hover, per seed")
    deterministic: bool = Field(False, description="evaluate the mean action instead of samples")
    policy: Literal["best", "last"] = Field(
        "best", description="which policy of a run is evaluated"
    )
    plant: str | None = Field(
        None,
        max_length=4096,
        description="evaluate on this stand-in plant: a file or a name of configs/plant",
    )
    plants: int = Field(
        4, ge=1, le=1000, description="drones drawn from it, which share the runs equally"
    )


class Budget(Section):
    """When the sweep ends."""

    trials: int | None = Field(None, ge=1, le=MAX_TRIALS, description="null: a grid's size, or 20")
    seconds: Positive | None = Field(None, description="wall time after which no trial starts")


class Executor(Section):
    """Where trials run."""

    kind: Literal["local", "ray"] = Field("local", description="processes, or tasks on Ray")
    workers: int | None = Field(None, ge=1, le=4096, description="trials at once; null: all fit")
    cpus: float = Field(1.0, gt=0, le=4096, description="CPUs of a trial, for ray")
    gpus: float = Field(0.0, ge=0, le=64, description="GPUs of a trial; 0.25: four share one")
    address: str = Field("auto", description="of the Ray cluster; auto: the running one")
    retries: int = Field(1, ge=0, le=100, description="of a trial whose process or node died")


class SweepFile(Section):
    """A sweep file."""

    name: FolderName = Field("sweep", description="of the study")
    config: str = Field(
        description="base config: a file next to the sweep file, or a preset; with parts, if any: "
        "e2e +fastest"
    )
    overrides: dict[str, Any] = Field(
        {}, max_length=1000, description="changes to it, the same for every trial"
    )
    space: dict[str, Range] = Field(
        min_length=1, max_length=100, description="values by dotted key of the config"
    )
    conditions: dict[str, Any] = Field(
        {}, max_length=1000, description="the race in which policies are evaluated"
    )
    search: Search = Search()
    objective: Objective = Objective()
    budget: Budget = Budget()
    executor: Executor = Executor()
    storage: str = Field("journal", description="journal, or postgresql://USER@HOST/DATABASE")

    @model_validator(mode="after")
    def _check(self) -> "SweepFile":
        if self.storage != "journal" and not DATABASE.fullmatch(self.storage):
            raise ValueError(
                "storage: allowed: journal, or postgresql://USER:PASSWORD@HOST:PORT/DATABASE?KEY="
                "VALUE, in which special characters are percent-encoded"
            )
        objective, plants = self.objective, self.objective.plants
        if objective.plant is not None and objective.runs % plants:
            allowed = f"multiples of objective.plants ({plants})"
            raise ValueError(f"objective.runs is {objective.runs}, allowed: {allowed}")
        if objective.plant is not None and self.conditions:
            raise ValueError("conditions: allowed: none with objective.plant")
        if objective.plant is None and plants != Objective().plants:
            raise ValueError(f"objective.plants is {plants}, allowed: only with objective.plant")
        if self.search.method == "grid" and self.search.base_first:
            raise ValueError("search.base_first is true, allowed: false for a grid")
        return self


def stored(value: Any) -> Value:
    """A config's value as Optuna stores it."""
    return json.dumps(value) if isinstance(value, (list, tuple, dict)) else value


def size_of(distribution: Distribution) -> float:
    """The number of values; infinite for a continuous interval."""
    if isinstance(distribution, CategoricalDistribution):
        return len(distribution.choices)
    if distribution.step is None:
        return math.inf
    return round((distribution.high - distribution.low) / distribution.step) + 1


def grid_of(distribution: Distribution, points: int | None) -> list[Value]:
    """Every value of a grid; ``ValueError`` for an interval without ``step`` or ``points``."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    size = points or size_of(distribution)
    if math.isinf(size) or (distribution.log and not points):
        raise ValueError("a grid needs choices, step or points")
    spaced = np.geomspace if distribution.log else np.linspace
    numbers = spaced(distribution.low, distribution.high, min(int(size), MAX_TRIALS + 1)).tolist()
    whole = isinstance(distribution, IntDistribution)
    return sorted({round(number) for number in numbers}) if whole else numbers


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A checked sweep."""

    file: SweepFile
    base: Path  # the base config
    overrides: tuple[str, ...]  # changes to it, the same for every trial
    space: Mapping[str, Distribution]
    conditions: tuple[str, ...]  # overrides: the race in which every policy is evaluated

    def override(self, key: str, value: Value) -> str:
        """The ``key=value`` override of a stored value of the space."""
        choices = self.file.space[key].choices or ()
        return override(key, next((x for x in choices if stored(x) == value), value))

    def suggest(self, trial: optuna.Trial, key: str) -> Value:
        """The value of a key of the space in a trial."""
        d = self.space[key]
        if isinstance(d, CategoricalDistribution):
            return trial.suggest_categorical(key, d.choices)
        if isinstance(d, IntDistribution):
            return trial.suggest_int(key, d.low, d.high, step=d.step, log=d.log)
        return trial.suggest_float(key, d.low, d.high, step=d.step, log=d.log)

    def config_of(self, params: Params, *more: str) -> Config:
        """A trial's config with more overrides; ``InputError`` if they do not go together."""
        changes = [self.override(key, value) for key, value in params.items()]
        return load_config(self.base, [*self.overrides, *changes, *more])

    def base_params(self) -> Params:
        """The base config's values of the keys of the space."""
        config = load_config(self.base, self.overrides)
        return {key: stored(value_at(config, key)) for key in self.space}

    def grid(self) -> dict[str, list[Value]]:
        """Every value of a grid by key."""
        values = {}
        for key, distribution in self.space.items():
            with prefixed(f"space.{key}"):
                values[key] = grid_of(distribution, self.file.space[key].points)
        return values

    @property
    def trials(self) -> int:
        """The budget, or all points of a grid or of a small space that is searched at random."""
        given, method = self.file.budget.trials, self.file.search.method
        if method == "grid":
            points, limit = math.prod(map(len, self.grid().values())), given or MAX_TRIALS
            if points > limit:
                raise InputError(f"the grid has {points} points, allowed by budget.trials: {limit}")
            return points
        size = math.prod(map(size_of, self.space.values())) if method == "random" else math.inf
        if given and given > size:
            allowed = f"at most {size:.0f}, the number of points of the space"
            raise InputError(f"budget.trials is {given}, allowed: {allowed}")
        return given or int(min(TRIALS, size))

    def queue(self) -> list[Params]:
        """Parameters of all trials, whatever order they end in; empty where TPE chooses them."""
        search = self.file.search
        if search.method == "grid":
            values = self.grid()
            return [dict(zip(values, x, strict=True)) for x in itertools.product(*values.values())]
        count = self.trials if search.method == "random" else min(search.startup, self.trials)
        drawn = self.draws(count, search.seed, [self.base_params()] if search.base_first else [])
        return [*drawn, *({} for _ in range(self.trials - count))]

    def draws(self, count: int, seed: int, first: Sequence[Params] = ()) -> list[Params]:
        """Random parameters after the ``first`` ones, up to ``count``.

        All differ until the space has no others. The first ones of a longer list are the same.
        """
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
        size, result = math.prod(map(size_of, self.space.values())), [*first]
        while len(result) < count:
            params = study.ask(dict(self.space)).params
            if params not in result or len(result) >= size:
                result.append(params)
        return result

    def check(self) -> None:
        """Check the budget, and combinations of the ends of all ranges.

        They are all combinations, or each end with random other values where there are many.

        Raises:
            InputError: values that do not go together, or a base outside of its space.
        """
        ends = [
            list(d.choices) if isinstance(d, CategoricalDistribution) else [d.low, d.high]
            for d in self.space.values()
        ]
        if math.prod(map(len, ends)) <= COMBINATIONS:
            tried = [dict(zip(self.space, x, strict=True)) for x in itertools.product(*ends)]
        else:
            alone = [{k: x} for k, values in zip(self.space, ends, strict=True) for x in values]
            tried = [a | b for a, b in zip(self.draws(len(alone), 0), alone, strict=True)]
        for params in tried:
            with prefixed("space: " + ", ".join(self.override(*item) for item in params.items())):
                self.config_of(params)
        assert self.trials  # raises where the budget does not fit the space
        if self.file.search.base_first:
            with prefixed("search.base_first"):
                optuna.create_trial(
                    value=0.0, params=self.base_params(), distributions=dict(self.space)
                )

    def definition(self) -> dict[str, str]:
        """The settings that trials of one study must share, by dotted key."""
        parts = self.file.model_dump(exclude_none=True, include={"search", "objective", "space"})
        config = load_config(self.base, self.overrides).model_dump(mode="json", by_alias=True)
        parts |= {"conditions": self.conditions, "config": config}
        return {key: json.dumps(value) for key, value in flatten(parts, ENTRIES).items()}


def load_sweep(path: Path | str, overrides: Sequence[str] = ()) -> Sweep:
    """The sweep of a YAML file and ``key=value`` overrides, checked before anything is trained.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value, or values that do not go
            together; an unreadable file.
    """
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
    overrides = (*(f"+{part}" for part in parts), *(override(*x) for x in file.overrides.items()))
    config, space, race = load_config(base, overrides), {}, {}
    for key, values in file.space.items():
        with prefixed(f"space.{key}"):
            if key in SET_BY_SWEEP:
                raise ValueError(f"{key} is set by the sweep")
            value = value_at(config, key)
            space[key] = values.distribution(value)
        if key.split(".")[0] in RACE and key != "vehicle.model":
            race[key] = value
    conditions = tuple(override(*item) for item in (race | file.conditions).items())
    load_config(base, (*overrides, *conditions))
    if file.objective.plant is not None:
        load_plant_config(file.objective.plant)
        if config.evaluate.gates is not None:
            raise InputError("evaluate.gates: allowed: null with objective.plant")
    sweep = Sweep(file, base, overrides, space, conditions)
    sweep.check()
    return sweep
