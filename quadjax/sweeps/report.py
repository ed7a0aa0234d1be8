"""What a sweep found: a table of its trials, importances, figures and the best config."""

import csv
import dataclasses
import io
import warnings
from collections.abc import Sequence
from pathlib import Path

from quadjax.config.loading import load_config, to_yaml
from quadjax.core.files import write_text
from quadjax.evaluation.figures import save_figure
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.figures import parallel_figure, slice_figure
from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.space import Params
from quadjax.sweeps.store import State, Store

SHOWN = 10  # best trials of the printed table


@dataclasses.dataclass(frozen=True)
class TrialResult:
    """One trial that is over."""

    slot: int
    state: str  # complete | pruned | failed
    value: float | None  # s, the median over seeds
    values: tuple[float, ...]  # of the seeds
    seconds: float | None  # of wall time
    host: str
    params: Params
    error: str = ""


def results_of(store: Store) -> list[TrialResult]:
    """Every slot's last word: complete trials by value, then pruned ones, then failed ones."""
    latest: dict[int, TrialResult] = {}
    for trial in store.trials():
        own = trial.user_attrs
        if not trial.state.is_finished():
            latest.pop(own["slot"], None)  # a failed one that is queued again
            continue
        names = {State.COMPLETE: "complete", State.PRUNED: "pruned", State.FAIL: "failed"}
        latest[own["slot"]] = TrialResult(
            slot=own["slot"],
            state=names[trial.state],
            value=trial.value if trial.state != State.FAIL else None,
            values=tuple(own.get("values", ())),
            seconds=own.get("seconds"),
            host=own.get("worker", {}).get("host", ""),
            params=dict(trial.params),
            error=own.get("error", "") if trial.state == State.FAIL else "",
        )
    order = ("complete", "pruned", "failed")
    return sorted(
        latest.values(),
        key=lambda r: (order.index(r.state), float("inf") if r.value is None else r.value, r.slot),
    )


def importances(store: Store, results: Sequence[TrialResult]) -> dict[str, float]:
    """How much of the value each key explains, adding up to one; empty where trials are too few.

    By Optuna's PED-ANOVA (Watanabe et al., 2023), over complete trials.
    """
    values = {r.value for r in results if r.state == "complete"}
    if len(values) < 3:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            return optuna.importance.get_param_importances(store.study(), evaluator=evaluator)
        except (RuntimeError, ValueError):
            return {}


def shown(value: object) -> str:
    """A parameter as the table shows it."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def format_results(results: Sequence[TrialResult], keys: Sequence[str]) -> str:
    """A Markdown table, a line per trial."""
    names = _short(keys)
    titles = ["trial", "median", "seeds", "wall s", *names, ""]
    lines = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for r in results:
        note = r.error if r.state == "failed" else r.state.replace("complete", "")
        cells = [
            str(r.slot),
            "-" if r.value is None else f"{r.value:.3f}",
            " ".join(f"{value:.2f}" for value in r.values) or "-",
            "-" if r.seconds is None else f"{r.seconds:.0f}",
            *(shown(r.params[key]) if key in r.params else "-" for key in keys),
            note,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _short(keys: Sequence[str]) -> list[str]:
    """The last words of the keys, or the keys where those are not enough."""
    last = [key.split(".")[-1] for key in keys]
    return [end if last.count(end) == 1 else key for key, end in zip(keys, last, strict=True)]


def format_importances(found: dict[str, float]) -> str:
    """A Markdown table, the most important key first."""
    lines = ["| key | importance |", "|---|---|"]
    ordered = sorted(found.items(), key=lambda item: -item[1])
    return "\n".join([*lines, *(f"| {key} | {share:.2f} |" for key, share in ordered)])


def best_yaml(sweep: Sweep, best: TrialResult) -> str:
    """The best trial's full config, which ``quadjax train`` takes."""
    config = sweep.config_of(best.params, f"{sweep.file.name}_best", 0)
    devices = load_config(sweep.base, sweep.words).train.devices
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, devices=devices))
    seeds = ", ".join(f"{value:.3f}" for value in best.values)
    measure = sweep.file.objective.measure.replace("_", " ")
    return (
        f"# The best of the sweep {sweep.file.name}: trial {best.slot}, {measure} "
        f"{best.value:.3f} s (seeds: {seeds}).\n" + to_yaml(config)
    )


def table_csv(results: Sequence[TrialResult], keys: Sequence[str]) -> str:
    """All trials, one row each."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(["trial", "state", "value", "seeds", "seconds", "host", *keys, "error"])
    for r in results:
        own = [r.slot, r.state, r.value, " ".join(map(str, r.values)), r.seconds, r.host]
        writer.writerow([*own, *(r.params.get(key, "") for key in keys), r.error])
    return stream.getvalue()


def write_report(store: Store) -> str:
    """Write everything into the sweep's folder; returns what to print.

    ``trials.csv``, ``report.md``, ``best.yaml``, ``parallel.png`` and ``slices.png``.
    """
    sweep, directory = store.sweep, store.directory
    results = results_of(store)
    keys = [d.key for d in sweep.dimensions]
    write_text(directory / "trials.csv", table_csv(results, keys))
    complete = [r for r in results if r.state == "complete"]
    text = [format_results(results[:SHOWN], keys)]
    found = importances(store, results)
    if found:
        text += ["", format_importances(found)]
    else:
        text += ["", "Importances need three complete trials of different values."]
    _write_markdown(sweep, directory / "report.md", results, found)
    if complete:
        write_text(directory / "best.yaml", best_yaml(sweep, complete[0]))
        over = [r for r in results if r.value is not None]
        save_figure(parallel_figure(sweep, over), directory / "parallel.png")
        save_figure(slice_figure(sweep, over), directory / "slices.png")
        text.append(f"best config: quadjax train {directory / 'best.yaml'}")
    text.append(f"all trials, report and figures are in {directory}")
    return "\n".join(text)


def _write_markdown(
    sweep: Sweep, path: Path, results: Sequence[TrialResult], found: dict[str, float]
) -> None:
    objective, keys = sweep.file.objective, [d.key for d in sweep.dimensions]
    head = (
        f"# {sweep.file.name}\n\n{len(results)} trials of {sweep.trials}; "
        f"{sweep.file.search.method}; median over {objective.seeds} seeds of "
        f"{objective.measure.replace('_', ' ')}, s. Base: `{sweep.base.name}`"
        + (f" with `{' '.join(sweep.words)}`" if sweep.words else "")
        + ".\n\n"
    )
    tail = f"\n\n{format_importances(found)}" if found else ""
    write_text(path, head + format_results(results, keys) + tail + "\n")


def present(store: Store) -> None:
    """Write the report and print its best part."""
    print(write_report(store))
