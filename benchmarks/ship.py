"""Copy a median seed into the package: ``python -m benchmarks.ship NAME RUN... [--file FILE]``.

The runs are those of the rows of NAME: a preset of ``benchmarks/results/presets.json``, or a step
of ``interventions.json``, in the order of their seeds. Of the policies that finish often enough it
takes the one whose time is nearest to the median of all:

- a preset flies in the simulator: 95% of the sampled flights from random starts, time of the mean
  action;
- a step flies on ``cyberzoo``: 98% of the sampled flights, whose time it is.

The policy is written to ``quadjax/pretrained``; its ``source`` gets the training's command and
commit. Its rows in ``shipped.json`` and ``body.json`` have to be measured again
(``benchmarks.results``).
"""

import dataclasses
import shlex
import statistics
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import quadjax
from benchmarks import rows
from benchmarks.comparison_tables import flights
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED

SIMULATED, POPULATION = 0.95, 0.98  # share of flights that has to finish


class Trained(NamedTuple):
    """What is known of one training."""

    seed: int
    time: float  # s; NaN where no flight finishes
    share: float  # of the flights, that finish
    config: list[str]  # preset and overrides
    commit: str


def median_of(times: Sequence[float], often: Sequence[bool]) -> int:
    """The index of the time nearest to the median, of the policies that finish often enough."""
    median = statistics.median(time for time in times if np.isfinite(time))
    allowed = [index for index, enough in enumerate(often) if enough]
    if not allowed:
        raise InputError("no training finishes often enough")
    return min(allowed, key=lambda index: abs(times[index] - median))


def trained(name: str) -> tuple[list[Trained], float]:
    """The trainings of a name in the order of their seeds, and the share that has to finish."""
    presets = {row["name"]: row for row in rows.read("presets")}
    steps = [row for row in rows.read("interventions") if row["step"] == name]
    if name in presets:
        row = presets[name]
        shares = [x / row["flights"] for x in row["finished"]["sampled, random"]]
        columns = zip(row["seeds"], row["total"]["mean"], shares, strict=True)
        return [Trained(*x, name.split(), row["commit"]) for x in columns], SIMULATED
    if not steps:
        raise InputError(f"{name}: no such row, allowed: {', '.join(presets)}, or a step")
    found = []
    for row in sorted(steps, key=lambda row: row["seeds"]):
        times = flights([row]).sum(axis=-1)
        done = np.isfinite(times)
        time = float(times[done].mean()) if done.any() else float("nan")
        found.append(Trained(*row["seeds"], time, done.mean(), row["config"], row["commit"]))
    return found, POPULATION


def ship(name: str, /, *folders: str, file: str | None = None, least: float | None = None) -> None:
    """Write the policy and print its seed.

    Args:
        name: of the rows.
        folders: runs of its seeds, in the order of the seeds.
        file: name of the policy (default: that of the preset).
        least: share of the flights that has to finish, in place of the rule.
    """
    known, share = trained(name)
    share = share if least is None else least
    runs = [quadjax.Run.load(folder) for folder in folders]
    if [run.config.seed for run in runs] != [each.seed for each in known]:
        seeds = [each.seed for each in known]
        raise InputError(f"{name}: the seeds of the runs are not those of the rows, {seeds}")
    times = [each.time for each in known]
    index = median_of(times, [each.share >= share for each in known])
    chosen, policy = known[index], runs[index].policy
    command = ["quadjax", "train", *chosen.config, "run.devices=1", f"seed={chosen.seed}"]
    source = policy.source | {"command": shlex.join(command), "commit": chosen.commit}
    written = PRETRAINED / f"{file or name.replace(' +', '_')}.npz"
    dataclasses.replace(policy, source=source).save(written)
    print(f"{written.name}: seed {chosen.seed}; s, of the seeds: {times}")


if __name__ == "__main__":
    script(ship)
