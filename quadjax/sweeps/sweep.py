"""Sweeps: a sweep file with its base config, and the check that each of its trials can run."""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import optuna
from optuna.distributions import CategoricalDistribution, IntDistribution

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, prefixed, short
from quadjax.core.resources import find_file
from quadjax.core.section_keys import value_at
from quadjax.core.sections import validate
from quadjax.core.yaml_files import flatten, override, parse_overrides, read_yaml
from quadjax.core.yaml_layers import Layer, merge_layers
from quadjax.plant.config import load_plant_config
from quadjax.sweeps.schema import (
    ENTRIES,
    MAX_TRIALS,
    WAYS,
    Distribution,
    SweepFile,
    Value,
    stored,
)

DEFAULT_TRIALS = 20  # of a sweep without a budget
MAX_COMBINATIONS = 64  # of the space's ends that are all checked
SET_BY_SWEEP = ("name", "seed", "run.devices", "run.tensorboard")
RACE = ("vehicle", "track", "rules", "randomization", "disturbance", "start", "evaluate")
Params = dict[str, Value]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A checked sweep."""

    file: SweepFile
    base: Path  # the base config
    overrides: tuple[str, ...]  # changes to it, the same for every trial
    space: Mapping[str, Distribution]
    conditions: tuple[str, ...]  # overrides: the race in which every policy is evaluated

    def suggest(self, trial: optuna.Trial) -> Params:
        """The parameters of a trial."""
        for key, d in self.space.items():
            if isinstance(d, CategoricalDistribution):
                trial.suggest_categorical(key, d.choices)
            elif isinstance(d, IntDistribution):
                trial.suggest_int(key, d.low, d.high, step=d.step, log=d.log)
            else:
                trial.suggest_float(key, d.low, d.high, step=d.step, log=d.log)
        return trial.params

    def make_config(self, params: Params, *more: str) -> Config:
        """A trial's config with more overrides; ``InputError`` if they do not go together."""
        choices = {key: self.file.space[key].choices or () for key in params}
        changes = [
            override(key, next((x for x in choices[key] if stored(x) == value), value))
            for key, value in params.items()
        ]
        return load_config(self.base, [*self.overrides, *changes, *more])

    def base_params(self) -> Params:
        """The base config's values of the keys of the space."""
        config = load_config(self.base, self.overrides)
        return {key: stored(value_at(config, key, missing=1.0)) for key in self.space}

    def grid(self) -> dict[str, list[Value]]:
        """The values of a grid by key; ``InputError`` for an interval without points."""
        grid = {}
        for key, distribution in self.space.items():
            with prefixed(f"space.{key}"):
                grid[key] = self.file.space[key].grid(distribution)
        return grid

    @property
    def trials(self) -> int:
        """The budget; by default the size of the grid, or ``DEFAULT_TRIALS``."""
        budget = self.file.budget.trials
        if self.file.search.method != "grid":
            return budget or DEFAULT_TRIALS
        points, limit = math.prod(map(len, self.grid().values())), budget or MAX_TRIALS
        if points > limit:
            raise InputError(f"the grid has {points} points, allowed by budget.trials: {limit}")
        return points

    def check(self) -> None:
        """Check the budget, each end of all ranges, and their combinations where these are few.

        Raises:
            InputError: values that do not go together, or a base outside of its space.
        """
        ends = {
            key: list(d.choices) if isinstance(d, CategoricalDistribution) else [d.low, d.high]
            for key, d in self.space.items()
        }
        tried: list[Params] = [{key: x} for key, values in ends.items() for x in values]
        if math.prod(map(len, ends.values())) <= MAX_COMBINATIONS:
            tried = [dict(zip(ends, x, strict=True)) for x in itertools.product(*ends.values())]
        for params in tried:
            with prefixed("space: " + ", ".join(override(*item) for item in params.items())):
                self.make_config(params)
        assert self.trials  # raises where the budget does not fit the grid
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


def load_sweep(path: Path | str, changes: Sequence[str] = ()) -> Sweep:
    """The sweep of a YAML file and ``key=value`` changes, checked before anything is trained.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value, or values that do not go
            together; an unreadable file.
    """
    path = Path(path)
    layers: list[Layer] = [(path, read_yaml(path)), ("overrides", parse_overrides(changes))]
    for source, tree in layers:
        if isinstance(tree.get("space"), dict):
            tree["space"] = flatten(tree["space"], ENTRIES)
            for key, value in tree["space"].items():
                if not isinstance(value, dict):
                    allowed = f"a mapping with one of {', '.join(WAYS)}"
                    raise InputError(f"{source}: space.{key} is {short(value)}, allowed: {allowed}")
    file = validate(SweepFile, *merge_layers(layers, path))
    with prefixed(str(path)):
        name, *parts = file.config.split(" +")
        base = find_file(name, [path.parent])
        overrides = (
            *(f"+{part}" for part in parts),
            *(override(*item) for item in file.overrides.items()),
        )
        config, space, race = load_config(base, overrides), {}, {}
        for key, values in file.space.items():
            with prefixed(f"space.{key}"):
                if key in SET_BY_SWEEP:
                    raise ValueError(f"{key} is set by the sweep")
                value = value_at(config, key, missing=1.0)
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
