"""``quadjax train``."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from quadjax.cli import STARTED
from quadjax.cli import options as opt
from quadjax.cli.output import command_again, write_record, wrote
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config as TrainingConfig
    from quadjax.training.result import Run

SEEDS = Group("Several seeds", sort_key=2)


def train(
    config: opt.Config,
    /,
    *overrides: opt.Overrides,
    name: opt.RunName | None = None,
    output: opt.RunsFolder = Path("runs"),
    resume: opt.Flag = False,
    overwrite: opt.Flag = False,
    fine_tune: opt.PolicyFile | None = None,
    seeds: Annotated[opt.Seeds | None, Parameter(group=SEEDS)] = None,
    runs: Annotated[opt.Runs, Parameter(group=SEEDS)] = 100,
    figure: opt.Picture = None,
) -> int:
    """Train a racing policy.

    DIR/NAME gets the config, the metrics, the checkpoints, the policy file, the
    lap table and the figures. The same command with --resume continues a run that
    was stopped.

    With --seeds the config, or each of several, is trained once for each seed, one
    after the other. A config with parts is one word here ("e2e +fastest"). A finished
    run is not trained again. The first table has the training runs; 'last' and 'best'
    are lap times of the flights that run.score selects. The second one has mean and
    sampled flights of the best policies, from hover and from random starts. The figure
    shows the learning curves of all configs.

    Example: quadjax train e2e seed=3 run.steps=5000000 --name third

    Args:
        resume: Continue from the last checkpoint.
        overwrite: Remove an earlier run of the same name first.
        fine_tune: Continue from a policy and its critic, with all schedules at their ends.
        seeds: Train with each of these seeds and compare the runs.
        runs: Flights of each kind in the table of seeds.
        figure: Learning curves of the seeds (default: DIR/NAMES_seeds.png).
    """
    if overwrite and resume:
        raise InputError("--overwrite and --resume exclude each other")
    named = [*overrides, *([f"name={name}"] if name else [])]
    if seeds is not None:
        if resume or fine_tune is not None:
            raise InputError("--resume and --fine-tune have no effect with --seeds")
        return _seeds([config, *named], list(dict.fromkeys(seeds)), runs, output, figure, overwrite)
    if figure is not None:
        raise InputError("--figure has no effect without --seeds")
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.learners.devices import prepare_devices
        from quadjax.training.fine_tuning import fine_tuning

    settings = load_config(config, named)
    if fine_tune is not None:
        _check_fine_tuning(settings, fine_tune)
        settings = fine_tuning(settings, fine_tune)
    prepare_devices(settings.run.devices)
    with loading():
        from quadjax.learners.loop import NonFiniteError
        from quadjax.training import run

    folder = output / settings.name
    try:
        done = run.train(settings, folder, resume=resume, overwrite=overwrite, started=STARTED)
    except NonFiniteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not done.finished:
        print(f"Stopped and saved. Continue with: {command_again(more='--resume')}")
        return INTERRUPTED
    _present(done)
    return 0


def _check_fine_tuning(config: "TrainingConfig", file: Path) -> None:
    from quadjax.policy.file import Policy

    if config.run.initial_policy is not None:
        raise InputError("--fine-tune and run.initial_policy exclude each other")
    if Policy.load(file).value is None:
        raise InputError(
            f"--fine-tune: {file} has no critic, allowed: a policy with one; "
            f"run.initial_policy={file} starts with an untrained critic"
        )


def _present(run: "Run") -> None:
    """Evaluate the best policy, print its lap table and write table and figures to the folder."""
    with loading():
        from quadjax.cli.output import steps
        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.evaluation.curves import training_figure
        from quadjax.evaluation.evaluation import evaluate, lap_table
        from quadjax.evaluation.published import published_total
        from quadjax.training.advice import no_lap

    config, folder, name = run.config, run.folder, str(run.folder / "policy.npz")
    with steps() as report:
        report("timing laps and drawing")
        sampled = evaluate(run.policy, config, name=name)
        steady = evaluate(run.policy, config, deterministic=True, name=name)
        write_json(folder / "laps.json", sampled.to_json())
        write_json(folder / "laps_deterministic.json", steady.to_json())
        save_figure(steady.plot(), folder / "trajectory.png")
        metrics = run.metrics
        if len(metrics["steps"]):
            curves = training_figure({config.name: metrics}, config.name, published_total(config))
            save_figure(curves, folder / "curves.png")
    if not len(metrics["steps"]):
        print(f"{folder / 'metrics.csv'}: no rows, so there are no curves of the training")
    print(lap_table({result.label(): result for result in (sampled, steady)}))
    print(_summary(run, published_total(config)))
    if run.summary["best_lap_total"] is None:
        print(no_lap((*sampled.laps.crashes, *steady.laps.crashes), run.summary["steps"]))


def _amount(number: int) -> str:
    return f"{number / 1e6:.1f} million" if number >= 1e5 else f"{number:,}"


def _summary(run: "Run", published: tuple[str, float] | None) -> str:
    """Steps, time, memory and the folder of a run, as text; a published time if it was reached."""
    from quadjax.evaluation.published import first_under

    summary, devices = run.summary, run.summary["devices"]
    memory = summary.get("peak_memory_mib")
    line = (
        f"trained {_amount(summary['steps'])} steps in {summary['seconds']:.0f} s on "
        f"{devices} device{'' if devices == 1 else 's'}"
    )
    lines = [line if memory is None else f"{line}, {memory:.0f} MiB at most"]
    if published and (first := first_under(run.metrics, published[1])):
        seconds, steps = first
        lines.append(
            f"first under {published[1]:.2f} s after {seconds:.0f} s and {_amount(steps)} steps"
        )
    return "\n".join([*lines, f"policy, figures and metrics are in {run.folder}"])


def _seeds(
    words: Sequence[str],
    seeds: Sequence[int],
    runs: int,
    output: Path,
    figure: Path | None,
    overwrite: bool,
) -> int:
    """Train each config with each seed, draw the learning curves, and tabulate."""
    with loading():
        from quadjax.config.code import names_of_code
        from quadjax.config.loading import load_config
        from quadjax.core.plotting import save_figure
        from quadjax.core.provenance import provenance
        from quadjax.evaluation.curves import learning_figure
        from quadjax.evaluation.seeds import evaluate_seed, format_seeds

    configs, overrides = configs_of(words)
    trained = {name: load_config(file, overrides) for name, file in configs.items()}
    figure = figure or output / f"{'_and_'.join(configs)}_seeds.png"
    groups = {
        name: [
            train_once(
                file, [*overrides, f"seed={seed}", f"name={name}_seed{seed}"], output, overwrite
            )
            for seed in seeds
        ]
        for name, file in configs.items()
    }
    code = [name for config in trained.values() for name in names_of_code(config)]
    save_figure(learning_figure(groups, code), figure)
    wrote(figure)
    for name, folders in groups.items():
        results = [evaluate_seed(folder, runs, code) for folder in folders]
        print(f"\n{name}\n\n{format_seeds(results)}\n")
        rows = [result.to_json() for result in results]
        write_record(output / f"{name}_seeds.json", {"results": rows}, provenance(trained[name]))
    return 0


def configs_of(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Config files by the name of their config, and the overrides among the arguments.

    Raises:
        InputError: a config that cannot be used, two of one name, or lap times that cannot
            be compared.
    """
    from quadjax.config.loading import load_config
    from quadjax.evaluation.curves import check_lengths

    overrides = [word for word in words if opt.is_override(word)]
    files = [word for word in words if word not in overrides]
    configs = [load_config(path, overrides) for path in files]
    names = [config.name for config in configs]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two of the configs are named {name}, expected names that differ")
    check_lengths({config.name: config.evaluate.length for config in configs})
    return dict(zip(names, files, strict=True)), overrides


def train_once(
    config: str, overrides: Sequence[str], output: Path, overwrite: bool = False
) -> Path:
    """Train in a separate process; returns the folder of the run.

    Resumes a run that was stopped, and leaves a finished one of the same config as it is.

    Raises:
        InputError: there is a run of that name with another config, or the training failed (its
            message has been printed).
        KeyboardInterrupt: the training was interrupted; it has saved.
    """
    from quadjax.config.loading import load_config
    from quadjax.training.folder import check_same
    from quadjax.training.result import is_finished

    settings = load_config(config, overrides)
    folder = output / settings.name
    if not overwrite:
        check_same(settings, folder)
        if is_finished(folder):
            return folder
    how = "--overwrite" if overwrite else "--resume"
    command = [sys.executable, "-m", "quadjax", "train", config, *overrides, how]
    status = subprocess.run([*command, "--output", str(output)], check=False).returncode
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status:
        raise InputError(f"training {settings.name} failed with status {status}")
    return folder
