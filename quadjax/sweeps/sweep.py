"""Sweeps: the search space, the parameters of the trials, and the check that each can run."""

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
from quadjax.core.errors import InputError, prefixed
from quadjax.core.resources import find_file
from quadjax.core.sections import validate, value_at
from quadjax.core.yaml_files import flatten, merge_trees, override, parse_overrides, read_yaml
from quadjax.plant.config import load_plant_config
from quadjax.sweeps.schema import (
    ENTRIES,
    MAX_TRIALS,
    Distribution,
    SweepFile,
    Value,
    stored,
    values_of,
)

TRIALS = 20  # of a sweep without a budget
COMBINATIONS = 64  # of the space's ends that are all checked
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

    def override(self, key: str, value: Value) -> str:
        """The ``key=value`` override of a stored value of the space."""
        choices = self.file.space[key].choices or ()
        return override(key, next((x for x in choices if stored(x) == value), value))

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

    def config_of(self, params: Params, *more: str) -> Config:
        """A trial's config with more overrides; ``InputError`` if they do not go together."""
        changes = [self.override(key, value) for key, value in params.items()]
        return load_config(self.base, [*self.overrides, *changes, *more])

    def base_params(self) -> Params:
        """The base config's values of the keys of the space."""
        config = load_config(self.base, self.overrides)
        return {key: stored(value_at(config, key, missing=1.0)) for key in self.space}

    def grid(self) -> dict[str, list[Value]]:
        """Every value of a grid by key."""
        grid = {}
        for key, distribution in self.space.items():
            points = self.file.space[key].points
            values = values_of(distribution, points)
            if values is None or (self.file.space[key].log and not points):
                raise InputError(f"space.{key}: a grid needs choices, step or points")
            grid[key] = values
        return grid

    def size(self) -> float:
        """The number of points of the space; infinite with a continuous interval."""
        values = map(values_of, self.space.values())
        return math.prod(math.inf if v is None else len(v) for v in values)

    @property
    def trials(self) -> int:
        """The budget, or all points of a grid or of a small space that is searched at random."""
        budget, method = self.file.budget.trials, self.file.search.method
        if method == "grid":
            points, limit = math.prod(map(len, self.grid().values())), budget or MAX_TRIALS
            if points > limit:
                raise InputError(f"the grid has {points} points, allowed by budget.trials: {limit}")
            return points
        size = self.size() if method == "random" else math.inf
        if budget and budget > size:
            allowed = f"at most {size:.0f}, the number of points of the space"
            raise InputError(f"budget.trials is {budget}, allowed: {allowed}")
        return budget or int(min(TRIALS, size))

    def queue(self) -> list[Params]:
        """Parameters of all trials, whatever order they end in; empty where TPE chooses them."""
        search = self.file.search
        if search.method == "grid":
            values = self.grid()
            return [dict(zip(values, x, strict=True)) for x in itertools.product(*values.values())]
        count = self.trials if search.method == "random" else min(search.startup, self.trials)
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=search.seed))
        size, drawn = self.size(), [self.base_params()] if search.base_first else []
        while len(drawn) < count:  # all differ until the space has no others
            params = study.ask(dict(self.space)).params
            if params not in drawn or len(drawn) >= size:
                drawn.append(params)
        return [*drawn, *({} for _ in range(self.trials - count))]

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
        if math.prod(map(len, ends.values())) <= COMBINATIONS:
            tried = [dict(zip(ends, x, strict=True)) for x in itertools.product(*ends.values())]
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


def load_sweep(path: Path | str, changes: Sequence[str] = ()) -> Sweep:
    """The sweep of a YAML file and ``key=value`` changes, checked before anything is trained.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value, or values that do not go
            together; an unreadable file.
    """
    path = Path(path)
    trees = [read_yaml(path), parse_overrides(changes)]
    for tree in trees:
        if isinstance(tree.get("space"), dict):
            tree["space"] = flatten(tree["space"], ENTRIES)
    file = validate(SweepFile, merge_trees(*trees), str(path))
    with prefixed(str(path)):
        name, *parts = file.config.split(" +")
        base = find_file(name, [path.parent])
        overrides = (
            *(f"+{part}" for part in parts),
            *(override(*x) for x in file.overrides.items()),
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
