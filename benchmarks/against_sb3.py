"""Train e2e_paper by quadjax and by Stable-Baselines3 for equal time, one after the other.

Both use the published hyperparameters, the same environment and one seed. Each side runs in a
separate process; its time counts from the start of that process. The laps are of the last policy,
deterministic from hover.

    python -m benchmarks.against_sb3 600 --figure sb3.png
"""

import dataclasses
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import output, script
from quadjax.cli.options import Count, JsonFile, Picture, whole
from quadjax.config.loading import load_config
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.learners.parallel import prepare_devices
from quadjax.studies import ppo_against_sb3 as study

PRESET = "e2e_paper"


def against_sb3(
    seconds: Annotated[Count, Parameter(name="SECONDS")],
    /,
    *,
    steps: Annotated[int | None, Parameter(converter=whole(1, 10**12))] = None,
    figure: Picture = None,
    json: JsonFile = None,
) -> None:
    """Train e2e_paper by quadjax and by Stable-Baselines3 for equal time.

    Args:
        seconds: Of each side.
        steps: End each side after this number of steps.
        figure: Draw both learning curves.
        json: Write the numbers.
    """
    sides = []
    with output.steps() as report:
        for kind in ("quadjax", "sb3"):
            report(kind)
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                sides.append(pool.apply(train_side, (kind, seconds, steps or 0, time.monotonic())))
    limits = f"{seconds} s of wall time" + (f" or {steps:,} steps" if steps else "")
    run = (
        f"{PRESET}, seed {study.SEED}, {limits} each from the start of the process; laps of the "
        "last policy, deterministic from hover"
    )
    print(study.format_sides(sides, run))
    if figure is not None:
        save_figure(study.curves_figure(sides, f"{PRESET}, seed {study.SEED}"), figure)
        output.wrote(figure)
    record = {"run": run, "sides": [dataclasses.asdict(side) for side in sides]}
    output.write_record(json, record, provenance(load_config(PRESET), seed=study.SEED))


def train_side(kind: str, seconds: int, steps: int, started: float) -> study.Side:
    """Train one side in this process; ``started`` is the time of its start."""
    learner = load_config(PRESET).learner
    per_update = learner.num_envs * learner.rollout_length
    config = load_config(PRESET, [f"run.evaluate_every={per_update}"])
    prepare_devices("auto" if kind == "quadjax" else "1")
    clock = study.Clock(started, seconds, steps)
    if kind == "sb3":
        return study.stable_baselines(config, clock, started)
    with tempfile.TemporaryDirectory() as folder:
        return study.ours(config, clock, started, Path(folder) / "run")


if __name__ == "__main__":
    script(against_sb3)
