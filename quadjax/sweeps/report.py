"""The report of a sweep: a table of its trials, figures, and the best config."""

import math
import shlex
from pathlib import Path

import optuna
from optuna.trial import FrozenTrial

from quadjax.config.loading import load_config
from quadjax.core.errors import quadjax_command
from quadjax.core.files import write_csv, write_text
from quadjax.core.markdown import table
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import describe_origin, provenance
from quadjax.evaluation.table import counted
from quadjax.sweeps.figures import figures
from quadjax.sweeps.study import OVER, State, number_of, trials_over
from quadjax.sweeps.sweep import Sweep

NAMES = dict(zip(OVER, ("complete", "pruned", "failed"), strict=True))
MAX_PRINTED = 10  # trials of the printed table


def make_table(study: optuna.Study, sweep: Sweep) -> list[list[str]]:
    """A line of titles, and one of each trial that is over: complete ones by value, pruned, failed.

    The lap times of the median and of the seeds are in s.
    """
    over = sorted(
        trials_over(study),
        key=lambda t: (OVER.index(t.state), math.inf if t.value is None else t.value),
    )
    titles = ("trial", "state", "median", "seeds", "finished", "wall s", "host")
    rows = [[*titles, *sweep.space, "error"]]
    for trial in over:
        attrs, median = trial.user_attrs, "" if trial.value is None else f"{trial.value:.3f}"
        died = "its worker died" if trial.state == State.FAIL else ""
        seeds = " ".join(f"{value:.3f}" for value in attrs.get("values", ()))
        cells = [number_of(trial), NAMES[trial.state], median, seeds, attrs.get("finished", 0.0)]
        cells += [str(attrs.get("seconds", "")), attrs.get("host", "")]
        cells += [*(trial.params.get(key, "") for key in sweep.space), attrs.get("error", died)]
        rows.append([f"{x:.4g}" if isinstance(x, float) else str(x) for x in cells])
    return rows


def write_report(study: optuna.Study, sweep: Sweep, directory: Path) -> str:
    """Write the report into the sweep's folder; returns what to print."""
    rows = make_table(study, sweep)
    write_csv(directory / "trials.csv", rows)
    name, seeds = sweep.file.name, sweep.file.objective.seeds
    head = f"# {name}\n\n{len(rows) - 1} trials of {sweep.trials}; {sweep.file.search.method}; "
    head += f"median over {counted(seeds, 'seed')} of the lap time, s. "
    head += f"Base: `{shlex.join([sweep.base.name, *sweep.overrides])}`."
    head += f"\n\n{describe_origin(provenance(load_config(sweep.base, sweep.overrides)))}"
    complete = study.get_trials(states=(State.COMPLETE,))
    last = "No policy finished a flight: every value is the penalty. Train for more steps."
    if finished := [trial for trial in complete if trial.user_attrs["finished"]]:
        best = min(finished, key=lambda trial: trial.values[0])
        config = sweep.make_config(best.params, f"name={name}_best")
        title = f"# Trial {number_of(best)} of {name}: lap time {best.value:.3f} s\n"
        write_text(directory / "best.yaml", title + config.to_yaml())
        draw([t for t in finished if t.user_attrs["finished"] >= 1.0] or finished, sweep, directory)
        last = f"best config: {quadjax_command('train', directory / 'best.yaml')}"
    write_text(directory / "report.md", f"{head}\n\n{table(rows)}\n\n{last}\n")
    printed = table(rows[: MAX_PRINTED + 1])
    return f"{printed}\n\n{last}\nall trials, report and figures: {directory}"


def draw(trials: list[FrozenTrial], sweep: Sweep, directory: Path) -> None:
    """Write the figures of complete trials."""
    best = min(trials, key=lambda trial: trial.values[0])
    race = load_config(sweep.base, sweep.overrides)
    title = f"{sweep.file.name}: {race.name}, {race.vehicle.name}, {race.track.name}; "
    title += f"{counted(len(trials), 'trial')}, best {best.values[0]:.2f} s"
    for name, figure in figures(trials, title).items():
        save_figure(figure, directory / f"{name}.png")
