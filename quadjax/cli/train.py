"""``quadjax train``."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from quadjax.cli import STARTED
from quadjax.cli import options as opt
from quadjax.cli.files import is_override
from quadjax.cli.output import note, resuming_command, steps, wrote
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config

DEFAULT_RUNS = 100
SEEDS = Group("Several seeds", sort_key=2)


def train(
    config: opt.ConfigName,
    /,
    *overrides: opt.Overrides,
    name: opt.RunName | None = None,
    output: opt.RunsFolder = Path("runs"),
    resume: opt.Flag = False,
    overwrite: opt.Flag = False,
    fine_tune: opt.PolicyFile | None = None,
    seeds: Annotated[opt.Seeds | None, Parameter(group=SEEDS)] = None,
    runs: Annotated[opt.Runs | None, Parameter(group=SEEDS)] = None,
    figure: opt.Picture = None,
) -> int:
    """Train a racing policy.

    DIR/NAME gets the config, the metrics, the checkpoints, the policy file, the
    lap table and the figures. The same command with --resume continues a run that
    was stopped.

    With --seeds the config, or each of several, is trained once for each seed, one
    after the other. Quote a config with its parts as one argument ("e2e +fastest"). A
    finished run is not trained again. The first table has the training runs; 'last' and
    'best' are the scores that run.score selects. The second table has mean and sampled
    flights of the best policies, from hover and from random starts. The figure shows the
    learning curves of all configs.

    Example: quadjax train e2e seed=3 run.steps=5000000 --name third

    Args:
        resume: Continue from the last checkpoint. With --name there has to be a run of that name.
        overwrite: Remove an earlier run of the same name first.
        fine_tune: Continue from a policy and its critic, with all schedules at their ends.
        seeds: Train with each of these seeds and compare the runs.
        runs: Flights of each kind in the table of seeds (default: 100).
        figure: Learning curves of the seeds (default: DIR/NAMES_seeds.png).
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.training.fine_tuning import fine_tuning
        from quadjax.training.folder import check_started

    opt.exclude(overwrite=overwrite, resume=resume)
    named = [*overrides, *([f"name={name}"] if name else [])]
    if seeds is not None:
        opt.refuse("with --seeds", resume=resume, fine_tune=fine_tune)
        _train_seeds([config, *named], seeds, runs or DEFAULT_RUNS, output, figure, overwrite)
        return 0
    opt.refuse("without --seeds", runs=runs, figure=figure)
    settings = load_config(config, named)
    if fine_tune is not None:
        settings = fine_tuning(settings, fine_tune)
    folder = output / settings.name
    if resume and name:
        check_started(folder)
    return _train(settings, folder, resume, overwrite)


def _train(config: "Config", folder: Path, resume: bool, overwrite: bool) -> int:
    """Train one policy and print its evaluation; returns the exit status."""
    with loading():
        from quadjax.evaluation.advice import before_training
        from quadjax.evaluation.training import write_evaluation
        from quadjax.learners.loop import NonFiniteError
        from quadjax.training import run
        from quadjax.training.result import is_finished

    finished = resume and is_finished(folder)
    for text in [] if finished else before_training(config):
        note(text)
    try:
        done = run.train(config, folder, resume=resume, overwrite=overwrite, started=STARTED)
    except NonFiniteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not done.finished:
        print(f"Stopped and saved. Continue with: {resuming_command()}")
        return INTERRUPTED
    if finished:
        ended = f"the run is finished ({done.summary['steps']:,} steps)"
        note(f"{folder}: {ended}; --overwrite trains again")
    with steps() as report:
        report("timing laps and drawing")
        text = write_evaluation(done)
    print(text)
    return 0


def _train_seeds(
    arguments: Sequence[str],
    seeds: Sequence[int],
    runs: int,
    output: Path,
    figure: Path | None,
    overwrite: bool,
) -> None:
    """Train each config among the arguments, with the overrides among them, with each seed."""
    changes = [argument for argument in arguments if is_override(argument)]
    files = [argument for argument in arguments if argument not in changes]
    if len(set(seeds)) < len(seeds):
        raise InputError(f"--seeds has a seed twice: {' '.join(map(str, seeds))}")
    if seed := [word for word in changes if word.startswith("seed=")]:
        raise InputError(f"{seed[0]} has no effect with --seeds {' '.join(map(str, seeds))}")
    with loading():
        from quadjax.evaluation.training import train_seeds

    for text, file in train_seeds(files, changes, seeds, runs, output, figure, overwrite):
        if text:
            print(text)
        wrote(file)
