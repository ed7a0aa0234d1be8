"""The keys of a sweep file."""

import json
from typing import Annotated, Any, Literal

import numpy as np
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from quadjax.core.errors import short
from quadjax.core.sections import Field, FolderName, Positive, Section, model_validator

WAYS = ("choices", "range", "log")  # to name the values of a key
ENTRIES = (*WAYS, "step", "points")
MAX_TRIALS = 10_000
JOURNAL = "journal"  # storage: a file in the folder of the sweep
End = Annotated[float, Field(ge=-1e12, le=1e12)]  # of an interval: no key takes larger numbers
Value = bool | int | float | str | None  # as Optuna stores it: lists as JSON text
Distribution = CategoricalDistribution | FloatDistribution | IntDistribution


def stored(value: Any) -> Value:
    """A config's value as Optuna stores it."""
    return json.dumps(value) if isinstance(value, (list, tuple, dict)) else value


class Range(Section):
    """The values of one key: exactly one of ``choices``, ``range`` and ``log``."""

    choices: tuple[Any, ...] | None = Field(
        None, min_length=1, max_length=1000, description="values"
    )
    range: tuple[End, End] | None = Field(None, description="lowest and highest value")
    log: tuple[End, End] | None = Field(None, description="the same, on a log scale")
    step: Positive | None = Field(None, description="distance of the values of a range")
    points: int | None = Field(None, ge=2, le=MAX_TRIALS, description="number of values of a grid")

    @model_validator(mode="after")
    def _check(self) -> "Range":
        ways = [way for way in WAYS if getattr(self, way) is not None]
        if len(ways) != 1:
            raise ValueError(f"expected one of choices, range and log, found {len(ways)}")
        if self.step and (self.range is None or self.points):
            raise ValueError(f"step is {self.step:g}, allowed: with range, without points")
        low, high = self.range or self.log or (0.0, 0.0)
        if low > high or (self.log and low <= 0):
            above = " above 0" if self.log else ""
            raise ValueError(f"{ways[0]} is {[low, high]}, allowed: [lowest, highest]{above}")
        count = (high - low) / (self.step or 1.0)
        if self.step and (round(count) < 1 or abs(count - round(count)) > 1e-6):
            allowed = f"a divisor of {high - low:g}, the length of the range"
            raise ValueError(f"step is {self.step:g}, allowed: {allowed}")
        return self

    def distribution(self, base: object) -> Distribution:
        """Optuna's, of a key whose value in the base config is ``base``; ``ValueError``."""
        if self.choices is not None:
            return CategoricalDistribution([stored(choice) for choice in self.choices])
        if isinstance(base, bool) or not isinstance(base, (int, float, type(None))):
            raise ValueError(f"the base has {short(base)}, no number, allowed: choices")
        low, high = self.range or self.log or (0.0, 1.0)
        whole = all(number.is_integer() for number in (low, high, self.step or 1.0))
        if isinstance(base, int) and not whole:
            raise ValueError(f"{[low, high]} with step {self.step}, allowed: whole numbers")
        if isinstance(base, float) or not whole:
            return FloatDistribution(low, high, self.log is not None, self.step)
        return IntDistribution(int(low), int(high), self.log is not None, int(self.step or 1))

    def grid(self, distribution: Distribution) -> list[Value]:
        """Its values in a grid; ``ValueError`` for an interval without a number of points."""
        if isinstance(distribution, CategoricalDistribution):
            return list(distribution.choices)
        low, high, step = distribution.low, distribution.high, distribution.step
        if not self.points and (step is None or distribution.log):
            raise ValueError("a grid needs choices, step or points")
        size = min(self.points or round((high - low) / (step or 1.0)) + 1, MAX_TRIALS + 1)
        numbers = (np.geomspace if distribution.log else np.linspace)(low, high, size).tolist()
        if isinstance(distribution, IntDistribution):
            return sorted({round(number) for number in numbers})
        return numbers


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
        description="evaluate on this plant: a file or a name of configs/plant",
    )
    drones: int = Field(
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
    storage: str = Field(
        JOURNAL, description="journal, or the URL of a database for Optuna, such as sqlite:///FILE"
    )

    @model_validator(mode="after")
    def _check(self) -> "SweepFile":
        if self.storage != JOURNAL and "://" not in self.storage:
            allowed = "journal, or the URL of a database, such as sqlite:///FILE"
            value = "***" if "@" in self.storage else self.storage  # it may contain a password
            raise ValueError(f"storage is {value!r}, allowed: {allowed}")
        plant, drones, runs = self.objective.plant, self.objective.drones, self.objective.runs
        if plant is not None and runs % drones:
            allowed = f"multiples of objective.drones ({drones})"
            raise ValueError(f"objective.runs is {runs}, allowed: {allowed}")
        if plant is not None and self.conditions:
            raise ValueError("conditions: allowed: none with objective.plant")
        if plant is None and drones != Objective().drones:
            raise ValueError(f"objective.drones is {drones}, allowed: only with objective.plant")
        if self.search.method == "grid" and self.search.base_first:
            raise ValueError("search.base_first is true, allowed: false for a grid")
        return self
