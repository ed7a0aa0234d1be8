"""``quadjax sweep``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.files import writable_folder
from quadjax.core.errors import INTERRUPTED, prefixed
from quadjax.core.folders import check_kind, claim, remove_files
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config

if TYPE_CHECKING:
    from optuna import Study

    from quadjax.sweeps.sweep import Sweep

FIGURES = ("parallel.png", "slices.png", "importances.png")
FILES = ("study.journal*", "trials", "trials.csv", "logs", "report.md", "best.yaml", *FIGURES)


def sweep(
    config: Annotated[str, Parameter(name="CONFIG"), opt.config_parameter("sweeps")],
    /,
    *overrides: opt.Overrides,
    workers: opt.Count | None = None,
    check: opt.Flag = False,
    report: opt.Flag = False,
    overwrite: opt.Flag = False,
    output: Annotated[opt.Folder, Parameter(help="Write to DIR/NAME.")] = Path("runs"),
) -> int:
    """Search a space of training configs.

    The same command resumes a sweep that was stopped or killed. With a database
    as storage, the same command on another machine runs trials of the same sweep.
    DIR/NAME gets the trials, their table, figures and the best config.

    Example: quadjax sweep learning_rate budget.trials=40

    Args:
        workers: Trials at the same time (executor.workers).
        check: Check the sweep and run nothing.
        report: Only report the finished trials.
        overwrite: Remove the trials first.
    """
    if not check:
        with prefixed("--output"):
            writable_folder(str(output))
    with loading():
        from quadjax.evaluation.table import counted
        from quadjax.sweeps.report import write_report
        from quadjax.sweeps.study import State, load_study, progress, trials_over
        from quadjax.sweeps.sweep import load_sweep

    changes = [*overrides, *([f"executor.workers={workers}"] if workers else [])]
    plan = load_sweep(find_config(config, "sweeps"), changes)
    folder = output / plan.file.name
    if check:
        trials, seeds = (counted(plan.trials, "trial"), counted(plan.file.objective.seeds, "seed"))
        print(f"{config}: {trials} of {seeds} can run")
        return 0
    if report:
        check_kind(folder, "sweep", () if overwrite else FILES)
        print(write_report(load_study(plan, folder), plan, folder))
        return 0
    study, ended = _run(plan, folder, overwrite)
    print(progress(study, plan))
    over = trials_over(study)
    if len(over) < plan.trials:
        print("The same command runs the rest.")
        return 0 if ended else INTERRUPTED
    return int(any(trial.state == State.FAIL for trial in over))


def _run(plan: "Sweep", folder: Path, overwrite: bool) -> tuple["Study", bool]:
    """Run the trials and print their report; returns the study, and False if it was stopped."""
    with loading():
        from quadjax.evaluation.table import counted
        from quadjax.sweeps.report import write_report
        from quadjax.sweeps.run import run_sweep, train_and_fly
        from quadjax.sweeps.study import delete_study, open_study
        from quadjax.sweeps.workers import LocalWorkers, RayWorkers

    executor, logs = plan.file.executor, folder / "logs"
    with claim(folder, "sweep", FILES, overwrite):
        if overwrite:
            delete_study(plan, folder)
            remove_files(folder, FILES)
        pool = RayWorkers(executor) if executor.kind == "ray" else LocalWorkers(executor, logs)
        size = f"{counted(plan.trials, 'trial')}, {counted(pool.count, 'worker')}"
        print(f"{plan.file.name}: {size} ({executor.kind})")
        ended = run_sweep(plan, folder, pool, train_and_fly)
        study = open_study(plan, folder)
        print(write_report(study, plan, folder))
    return study, ended
