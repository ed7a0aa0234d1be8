"""Copy a preset's median seed into the package: ``python -m benchmarks.ship ROW RUN...``.

The runs are those of ``python -m benchmarks.results measure ROW RUN...``, in the same order. Of the
policies that finish at least 95% of their sampled flights from random starts, it takes the one
whose time with the mean action is nearest to the median of all. The policy is written to
``quadjax/pretrained/PRESET.npz``; its ``source`` gets the training's command and commit. Its rows
in ``shipped.json`` and ``body.json`` have to be measured again (``benchmarks.results``).
"""

import dataclasses
import shlex
import statistics
from collections.abc import Sequence

import quadjax
from benchmarks import rows
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED

MIN_FINISHED = 0.95  # of the sampled flights from random starts


def median_of(times: Sequence[float], rates: Sequence[float]) -> int:
    """The index of the time nearest to the median, of the policies that finish often enough."""
    median = statistics.median(times)
    often = [index for index, rate in enumerate(rates) if rate >= MIN_FINISHED]
    return min(often, key=lambda index: abs(times[index] - median))


def ship(name: str, /, *folders: str) -> None:
    """Write the policy and print its seed.

    Args:
        name: Row of the preset in benchmarks/results/presets.json.
        folders: Runs of its seeds, in the order of the row.
    """
    presets = {row["name"]: row for row in rows.read("presets")}
    if name not in presets:
        raise InputError(f"{name}: no such row, allowed: {', '.join(presets)}")
    row = presets[name]
    runs = [quadjax.Run.load(folder) for folder in folders]
    if [run.config.seed for run in runs] != row["seeds"]:
        raise InputError(f"{name}: the seeds of the runs are not those of the row, {row['seeds']}")
    finished = row["finished"]["sampled, random"]
    index = median_of(row["total"]["mean"], [count / row["flights"] for count in finished])
    policy, seed = runs[index].policy, row["seeds"][index]
    command = shlex.join(["quadjax", "train", name, "run.devices=1", f"seed={seed}"])
    source = policy.source | {"command": command, "commit": row["commit"]}
    file = PRETRAINED / f"{name.replace(' +', '_')}.npz"
    dataclasses.replace(policy, source=source).save(file)
    print(f"{file.name}: seed {seed}; mean, s, of the seeds: {row['total']['mean']}")


if __name__ == "__main__":
    script(ship)
