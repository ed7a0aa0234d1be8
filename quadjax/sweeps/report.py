"""The report of a sweep: a table of its trials, importances, figures and the best config."""

import contextlib
import math
from pathlib import Path

import matplotlib.pyplot as plt
import optuna

from quadjax.config.loading import load_config
from quadjax.core.files import write_csv, write_text
from quadjax.core.markdown import table
from quadjax.core.provenance import line_of, provenance
from quadjax.sweeps.study import OVER, State, latest_trials
from quadjax.sweeps.sweep import Sweep

SHOWN = 10  # trials of the printed table
STATES = {State.COMPLETE: "complete", State.PRUNED: "pruned", State.FAIL: "failed"}
TITLES = ("trial", "state", "median", "seeds", "finished", "wall s", "host")


def results_of(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """The trials that are over: complete ones by value, then pruned ones, then failed ones."""
    trials = latest_trials(study).values()
    over = [t for t in trials if t.state in OVER or "error" in t.user_attrs]
    order = {state: place for place, state in enumerate(STATES)}
    return sorted(over, key=lambda t: (order[t.state], math.inf if t.value is None else t.value))


def importances(study: optuna.Study) -> dict[str, float]:
    """The fraction of the variance that each key explains, by PED-ANOVA (Watanabe et al., 2023).

    Over complete trials; empty where there are too few.
    """
    if len({t.value for t in study.get_trials(False, (State.COMPLETE,))}) >= 3:
        with contextlib.suppress(RuntimeError, ValueError):
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            return optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {}


def rows_of(results: list[optuna.trial.FrozenTrial], keys: list[str]) -> list[list[str]]:
    """A table with a line of titles and a line for each trial; times in s."""
    rows = [[*TITLES, *keys, "error"]]
    for t in results:
        own, value = t.user_attrs, "" if t.value is None else f"{t.value:.3f}"
        seeds = " ".join(f"{value:.3f}" for value in own.get("values", ()))
        measured = [value, seeds, f"{own.get('finished', 0.0):.2f}"]
        measured += [str(own.get(key, "")) for key in ("seconds", "host")]
        params = [t.params.get(key, "") for key in keys]
        texts = [f"{x:.4g}" if isinstance(x, float) else str(x) for x in params]
        rows.append([str(own["index"]), STATES[t.state], *measured, *texts, own.get("error", "")])
    return rows


def write_report(study: optuna.Study, sweep: Sweep, directory: Path) -> str:
    """Write the report into the sweep's folder; returns what to print."""
    results = results_of(study)
    rows = rows_of(results, [*sweep.space])
    write_csv(directory / "trials.csv", rows)
    found = sorted(importances(study).items(), key=lambda item: -item[1])
    explained = "Importances need three complete trials of different values."
    if found:
        explained = table([("key", "importance"), *((key, f"{x:.2f}") for key, x in found)])
    name, method, seeds = sweep.file.name, sweep.file.search.method, sweep.file.objective.seeds
    head = f"# {name}\n\n{len(results)} trials of {sweep.trials}; {method}; median over {seeds} "
    head += f"seeds of the lap time, s. Base: `{' '.join([sweep.base.name, *sweep.overrides])}`."
    head += f"\n\n{line_of(provenance(load_config(sweep.base, sweep.overrides)))}"
    finished = [t for t in results if t.state == State.COMPLETE and t.user_attrs["finished"]]
    last = "No policy finished a flight: every value is the penalty. Train for more steps."
    if finished:
        best = finished[0]
        config = sweep.config_of(best.params, f"name={name}_best")
        title = f"# Trial {best.user_attrs['index']} of {name}: lap time {best.value:.3f} s\n"
        write_text(directory / "best.yaml", title + config.to_yaml())
        draw(study, directory)
        last = f"best config: quadjax train {directory / 'best.yaml'}"
    write_text(directory / "report.md", f"{head}\n\n{table(rows)}\n\n{explained}\n\n{last}\n")
    shown = f"{table(rows[: SHOWN + 1])}\n\n{explained}\n{last}"
    return f"{shown}\nall trials, report and figures: {directory}"


def draw(study: optuna.Study, directory: Path) -> None:
    """Optuna's figures of the trials.

    They show the trials in which every flight finished, or any if there is none: the penalty of a
    crash is far from every lap time and would determine the scale.
    """
    from quadjax.core.plotting import save_figure

    complete = [t for t in study.get_trials(True, (State.COMPLETE,)) if t.user_attrs["finished"]]
    every = [t for t in complete if t.user_attrs["finished"] >= 1.0]
    shown = optuna.create_study(study_name=study.study_name)
    shown.add_trials(every or complete)
    plots = optuna.visualization.matplotlib
    for name, plot in (("parallel", plots.plot_parallel_coordinate), ("slices", plots.plot_slice)):
        plot(shown, target=lambda t: t.values[0], target_name="median (s)")
        figure = plt.gcf()
        figure.set_size_inches(max(8.0, 3.0 * len(shown.trials[0].params)), 4.5)
        save_figure(figure, directory / f"{name}.png")
