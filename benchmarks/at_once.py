"""Train seeds of several races in one program, for a GPU, which one training does not fill.

Each gets the folder that ``quadjax train`` writes, without a checkpoint. Each word of ``--each`` is
an override of one race. All need equally many gates and plain numbers for learner.num_envs and
learner.horizon. The trainings end at the first evaluation after ``limit`` seconds.

    python -m benchmarks.at_once e2e_paper --seeds 0 1 2 --output runs
    python -m benchmarks.at_once e2e_race vehicle=5inch learner.num_envs=104 learner.horizon=45 \
        --each track.generate.seed=1 track.generate.seed=2 --seeds 0 1 2
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import quadjax
from benchmarks.stacked import stack, train
from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.learners.loop import Plan
from quadjax.learners.schedules import Training
from quadjax.training import build
from quadjax.training.folder import FILES, KIND, prepare_folder

Words = Annotated[tuple[str, ...], options.LIST, Parameter(metavar="KEY=VALUE ...")]


def make_trainings(configs: Sequence[quadjax.Config]) -> list[tuple[Training, Plan]]:
    """Each training with its plan.

    Raises:
        InputError: trainings that cannot share one program.
    """
    made, first = [build.make_training(config) for config in configs], configs[0]
    (_, plan), run = made[0], first.run
    alike = run, first.evaluate, first.rules.time_step
    if run.score == "reward" or run.initial_policy or first.evaluate.gates:
        raise InputError(
            "run.score reward, run.initial_policy and evaluate.gates are not supported"
        )
    for config, (_, its_plan) in zip(configs, made, strict=True):
        same = (config.run, config.evaluate, config.rules.time_step) == alike
        if not same or its_plan != plan:
            raise InputError(f"--each: {config.name} cannot share the program of {first.name}")
    stack([training for training, _ in made])
    return made


def at_once(
    preset: str,
    *changes: str,
    seeds: options.Seeds,
    each: Words = (),
    output: options.Folder = Path("runs"),
    limit: Annotated[float, options.number(0.0, math.inf)] = math.inf,
) -> None:
    """Train the seeds of a preset, once for each override of ``--each``."""
    name, configs = quadjax.load(preset, changes).name, []
    for word in each or ("",):
        kind = f"{name}_{Path(word.rpartition('=')[2]).stem}" if word else name
        words = [*changes, word] if word else changes
        configs += [
            quadjax.load(preset, [*words, f"seed={x}", f"name={kind}_seed{x}"]) for x in seeds
        ]
    folders = [output / config.name for config in configs]
    if len(set(folders)) < len(folders):
        raise InputError(
            "--seeds, --each: two trainings have the same name, allowed: different ones"
        )
    made = make_trainings(configs)
    for config, folder in zip(configs, folders, strict=True):
        with claim(folder, KIND, FILES):
            prepare_folder(config, folder, resume=False, overwrite=False)
    train(configs, made, folders, limit)


if __name__ == "__main__":
    script(at_once)
