"""Sweep files: their keys, what they may be, and the check that every trial could run."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from quadjax.config.loading import fill, load_config, merge_trees, parse_words, read_yaml, to_yaml
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.sweeps.space import (
    ENTRIES,
    Dimension,
    Params,
    flatten,
    read_space,
    word,
    words_of,
)

RACE = ("vehicle", "track", "randomise", "disturbance", "start", "evaluate")  # sections
COMBINATIONS = 64  # at most so many combinations are checked before anything runs


@dataclass(frozen=True)
class SearchConfig:
    """How the space is searched."""

    method: str = "tpe"  # grid | random | tpe
    seed: int = 0
    base_first: bool = False  # the first trial is the base config itself
    startup: int = 10  # random trials before TPE begins
    pruner: str = "none"  # none | median | halving
    pruner_startup: int = 5  # trials that run to their end before any is pruned
    reports: int = 10  # times a seed's training reports to the pruner


@dataclass(frozen=True)
class ObjectiveConfig:
    """What a trial is judged by; the median over its seeds, lower is better."""

    measure: str = "lap_time"  # lap_time | seconds_to
    seeds: int = 3  # trained, from train seed 0
    flights: int = 16  # timed from hover with the policy's own noise
    deterministic: bool = False  # fly without noise
    policy: str = "best"  # best | last
    missing_lap: float = 8.0  # s counted for a lap that is not flown: the penalty for a crash
    target: float = 15.70  # s for all laps, for seconds_to


@dataclass(frozen=True)
class BudgetConfig:
    """When the sweep is over."""

    trials: int | None = None  # a grid's default: all its points; else 20
    seconds: float | None = None  # of wall time, after which no trial begins


@dataclass(frozen=True)
class SweepFile:
    """A sweep file without its space."""

    name: str = "sweep"  # results go to runs/NAME
    config: str = ""  # the base config, beside the sweep file or from the working folder
    search: SearchConfig = field(default_factory=SearchConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    storage: str = "journal"  # journal | postgresql://USER@HOST/DATABASE
    heartbeat_seconds: float = 15.0  # a silent worker of another machine is dead after six


@dataclass(frozen=True)
class Sweep:
    """A sweep, checked."""

    file: SweepFile
    base: Path  # the base config
    words: tuple[str, ...]  # changes to it, the same for every trial
    dimensions: tuple[Dimension, ...]
    trials: int  # the budget
    conditions: tuple[str, ...] = ()  # words: the race in which every trial's policy is judged

    def config_of(self, params: Mapping[str, object], name: str, seed: int) -> Config:
        """The config of a trial's run, on one device.

        Raises:
            InputError: the parameters do not go together.
        """
        own = [word("name", name), word("seed", seed), "train.devices='1'"]
        return load_config(self.base, [*self.words, *words_of(self.dimensions, params), *own])

    @property
    def first(self) -> Params | None:
        """The first trial's parameters where they are the base config's own."""
        if not self.file.search.base_first:
            return None
        config = load_config(self.base, self.words)
        return {d.key: d.plain(_base_value(config, d.key)) for d in self.dimensions}

    def definition(self) -> dict[str, str]:
        """What makes trials comparable, flat: a study takes only workers with the same."""
        base = to_yaml(load_config(self.base, self.words)).splitlines()
        parts = {
            "search": dataclasses.asdict(self.file.search),
            "objective": dataclasses.asdict(self.file.objective),
        }
        flat = {key: repr(value) for key, value in flatten(parts).items()}
        for d in self.dimensions:
            flat[f"space.{d.key}"] = repr(
                d.choices or (d.kind, d.low, d.high, d.log, d.step, d.points)
            )
        return flat | {"conditions": repr(self.conditions), "config": "\n".join(base)}


def difference(found: dict[str, str], wanted: dict[str, str]) -> str:
    """The first key in which two definitions of sweeps differ, and how."""
    for key in [*found, *wanted]:
        old, new = found.get(key, "nothing"), wanted.get(key, "nothing")
        if old == new:
            continue
        if key != "config":
            return f"{key} was {old}, is {new}"
        for before, now in zip(old.splitlines(), new.splitlines(), strict=False):
            if before != now:
                return f"the config said '{before.strip()}', says '{now.strip()}'"
    return "the config has more keys"


def load_sweep(path: Path | str, words: Sequence[str] = (), values: bool = True) -> Sweep:
    """The sweep of a YAML file and ``key=value`` words, checked as far as can be without training.

    Args:
        path: the sweep file.
        words: changes to it.
        values: try the space's values in the base config too, which takes a second or more.

    Raises:
        InputError: an unknown key, an impossible value, an impossible search space, in one line.
    """
    path = Path(path)
    tree, over = read_yaml(path), parse_words(words)
    space = _part(tree, "space", path, ENTRIES) | _part(over, "space", path, ENTRIES)
    overrides = _part(tree, "overrides", path) | _part(over, "overrides", path)
    asked = _part(tree, "conditions", path) | _part(over, "conditions", path)
    file = fill(SweepFile, merge_trees(tree, over), str(path))
    _check(file, str(path))
    base = _find_base(file.config, path)
    fixed = tuple(word(key, value) for key, value in overrides.items())
    try:
        config = load_config(base, fixed)
    except InputError as error:
        raise InputError(f"{path}: overrides: {error}") from error
    dimensions = read_space(space, config.algorithm, str(path))
    _check_measure(file, config, str(path))
    conditions = _conditions(asked, config, dimensions, base, fixed, str(path))
    trials = _trials(file, dimensions, str(path))
    sweep = Sweep(file, base, fixed, dimensions, trials, conditions)
    _check_first(sweep, str(path))
    if values:
        _check_values(sweep, str(path))
    return sweep


def _conditions(
    asked: dict[str, object],
    config: Config,
    dimensions: Sequence[Dimension],
    base: Path,
    fixed: Sequence[str],
    source: str,
) -> tuple[str, ...]:
    """The race that is the same for every trial: the base's, where the space varies it."""
    keys = [d.key for d in dimensions if d.key.split(".")[0] in RACE and d.key != "vehicle.kind"]
    values = {key: _base_value(config, key) for key in keys}
    words = tuple(word(key, value) for key, value in (values | asked).items())
    try:
        load_config(base, [*fixed, *words])
    except InputError as error:
        raise InputError(f"{source}: conditions: {error}") from error
    return words


def _base_value(config: Config, key: str) -> object:
    """The base's value of a key; a factor that it does not name is one."""
    node: object = config
    for part in key.split("."):
        node = node.get(part, 1.0) if isinstance(node, dict) else getattr(node, part)
    return node


def _part(tree: dict, name: str, path: Path, stop: Sequence[str] = ()) -> dict[str, object]:
    part = tree.pop(name, {})
    if not isinstance(part, dict):
        raise InputError(f"{path}: {name} is {part!r}, expected a mapping")
    return flatten(part, stop)


def _find_base(name: str, path: Path) -> Path:
    if not name:
        raise InputError(f"{path}: config is missing: the base config, such as ../e2e_shac.yaml")
    for place in (path.parent / name, Path(name)):
        if place.is_file():
            return place
    raise InputError(f"{path}: config: {name}: no such file")


def _check(file: SweepFile, source: str) -> None:
    def require(key: str, value: object, fine: bool, allowed: str) -> None:
        if not fine:
            raise InputError(f"{source}: {key} is {value!r}, allowed: {allowed}")

    search, objective, budget = file.search, file.objective, file.budget
    for key, value, allowed in (
        ("search.method", search.method, ("grid", "random", "tpe")),
        ("search.pruner", search.pruner, ("none", "median", "halving")),
        ("objective.measure", objective.measure, ("lap_time", "seconds_to")),
        ("objective.policy", objective.policy, ("best", "last")),
    ):
        require(key, value, value in allowed, ", ".join(allowed))
    for key, value in (
        ("search.startup", search.startup),
        ("search.reports", search.reports),
        ("objective.seeds", objective.seeds),
        ("objective.flights", objective.flights),
        ("budget.trials", budget.trials),
    ):
        require(key, value, value is None or value >= 1, "at least 1")
    for key, value in (
        ("objective.missing_lap", objective.missing_lap),
        ("objective.target", objective.target),
        ("budget.seconds", budget.seconds),
        ("heartbeat_seconds", file.heartbeat_seconds),
    ):
        require(key, value, value is None or (value > 0 and math.isfinite(value)), "positive")
    require("search.seed", search.seed, 0 <= search.seed < 2**31, f"0 to {2**31 - 1}")
    require("search.pruner_startup", search.pruner_startup, search.pruner_startup >= 0, "from 0")
    fine = bool(file.name) and all(c.isalnum() or c in "._-" for c in file.name)
    require("name", file.name, fine and not file.name.startswith("."), "letters, digits, . _ -")
    url = file.storage.split("@")[-1]  # without a password
    fine = file.storage == "journal" or file.storage.startswith("postgresql://")
    require("storage", url, fine, "journal, or postgresql://USER@HOST/DATABASE")


def _check_measure(file: SweepFile, config: Config, source: str) -> None:
    if file.objective.measure == "seconds_to" and file.search.pruner != "none":
        raise InputError(
            f"{source}: search.pruner is {file.search.pruner!r}, allowed: none, where "
            "objective.measure is seconds_to, which ends a run at its target"
        )


def _check_first(sweep: Sweep, source: str) -> None:
    first = sweep.first
    if first is None:
        return
    if sweep.file.search.method == "grid":
        raise InputError(f"{source}: search.base_first is True, allowed: False for a grid")
    for d in sweep.dimensions:
        value = first[d.key]
        if not d.holds(value):
            raise InputError(
                f"{source}: space.{d.key} is without the base config's {value}, which is to be "
                "the first trial (search.base_first)"
            )


def _trials(file: SweepFile, dimensions: Sequence[Dimension], source: str) -> int:
    """The budget; a grid's is all of its points."""
    if file.search.method != "grid":
        return file.budget.trials or 20
    try:
        size = math.prod(len(d.grid()) for d in dimensions)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    if file.budget.trials is not None and file.budget.trials < size:
        raise InputError(
            f"{source}: budget.trials is {file.budget.trials}, but the grid has {size} points"
        )
    return size


def _check_values(sweep: Sweep, source: str) -> None:
    """Every choice and both ends of every range, alone; then combinations of them."""
    for dimension in sweep.dimensions:
        for value in dimension.ends():
            shown = word(dimension.key, dimension.value(value))
            try:
                load_config(sweep.base, [*sweep.words, shown])
            except InputError as error:
                alone = len(sweep.dimensions) == 1
                if alone or not _may_depend(sweep, dimension, value):
                    raise InputError(f"{source}: space.{dimension.key}: {error}") from error
    for params in _combinations(sweep):
        try:
            sweep.config_of(params, "check", 0)
        except InputError as error:
            shown = ", ".join(words_of(sweep.dimensions, params))
            raise InputError(f"{source}: space: {shown}: {error}") from error


def _may_depend(sweep: Sweep, dimension: Dimension, value: object) -> bool:
    """Whether a value that the base config refuses goes with some value of another dimension."""
    random = np.random.default_rng(0)
    for _ in range(20):
        params = {d.key: d.draw(random) for d in sweep.dimensions} | {dimension.key: value}
        try:
            sweep.config_of(params, "check", 0)
        except InputError:
            continue
        return True
    return False


def _combinations(sweep: Sweep) -> list[Params]:
    """All combinations of the ends where they are few, else some of them and some at random."""
    keys = [d.key for d in sweep.dimensions]
    ends = [d.ends() for d in sweep.dimensions]
    if math.prod(len(values) for values in ends) <= COMBINATIONS:
        return [dict(zip(keys, values, strict=True)) for values in itertools.product(*ends)]
    random = np.random.default_rng(0)
    some = [[values[random.integers(len(values))] for values in ends] for _ in range(24)]
    found = [dict(zip(keys, values, strict=True)) for values in some]
    return found + [{d.key: d.draw(random) for d in sweep.dimensions} for _ in range(24)]
