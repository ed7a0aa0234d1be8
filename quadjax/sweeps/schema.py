"""The keys of a sweep file."""

import json
from typing import Annotated, Any, Literal

from quadjax.core.secrets import DATABASE
from quadjax.core.sections import Field, FolderName, Positive, Section, model_validator

ENTRIES = ("choices", "range", "log", "step", "points")  # of a key of the search space
MAX_TRIALS = 10_000
Bound = Annotated[float, Field(ge=-1e12, le=1e12)]


class Range(Section):
    """The values of one key: exactly one of ``choices``, ``range`` and ``log``."""

    choices: tuple[Any, ...] | None = Field(
        None, min_length=1, max_length=1000, description="values"
    )
    range: tuple[Bound, Bound] | None = Field(None, description="lowest and highest value")
    log: tuple[Bound, Bound] | None = Field(None, description="the same, on a log scale")
    step: Positive | None = Field(None, description="distance of the values of a range")
    points: int | None = Field(None, ge=2, le=10_000, description="number of values of a grid")

    @property
    def bounds(self) -> tuple[float, float]:
        """Of ``range`` or ``log``."""
        bounds = self.range or self.log
        assert bounds is not None
        return bounds

    @model_validator(mode="after")
    def _check(self) -> "Range":
        ways = [way for way in ENTRIES[:3] if getattr(self, way) is not None]
        if len(ways) != 1:
            raise ValueError(f"expected one of choices, range and log, found {len(ways)}")
        low, high = self.bounds if self.choices is None else (0.0, 1.0)
        if low >= high:
            raise ValueError(f"{ways[0]} [{low:g}, {high:g}], expected lowest < highest")
        texts = [json.dumps(choice) for choice in self.choices or []]
        if twice := [text for text in texts if texts.count(text) > 1]:
            raise ValueError(f"the choice {twice[0]} is there twice")
        if self.step and (self.range is None or self.points or self.step > high - low):
            raise ValueError(f"step is {self.step:g}, allowed: less than range, without points")
        return self


class Search(Section):
    """How the space is searched."""

    method: Literal["tpe", "random", "grid"] = Field("tpe", description="Optuna's sampler")
    seed: int = Field(0, ge=0, lt=2**31, description="seed of the sampler")
    base_first: bool = Field(False, description="the first trial is the base config")
    startup: int = Field(10, ge=1, le=MAX_TRIALS, description="random trials before TPE starts")
    pruner: Literal["none", "median", "halving"] = Field("none", description="stops bad trials")
    pruner_startup: int = Field(5, ge=0, le=MAX_TRIALS, description="trials before any is pruned")
    reports: int = Field(10, ge=1, le=1000, description="reports to the pruner in each training")


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
    space: dict[str, Any] = Field(
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
    heartbeat_seconds: int = Field(15, ge=1, le=3600, description="of Optuna, in a database")

    @model_validator(mode="after")
    def _check(self) -> "SweepFile":
        search = self.search
        if self.storage != "journal" and not DATABASE.fullmatch(self.storage):
            raise ValueError(
                "storage: allowed: journal, or postgresql://USER:PASSWORD@HOST:PORT/DATABASE?KEY="
                "VALUE, in which special characters are percent-encoded"
            )
        runs, plants = self.objective.runs, self.objective.plants
        if self.objective.plant is not None and runs % plants:
            raise ValueError(
                f"objective.runs is {runs}, allowed: multiples of objective.plants ({plants})"
            )
        if search.method == "grid" and search.base_first:
            raise ValueError("search.base_first is true, allowed: false for a grid")
        return self
