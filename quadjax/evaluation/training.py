"""What ``quadjax train`` writes and prints of a run: laps of its best policy, figures, time."""

from quadjax.core.files import write_json
from quadjax.core.plotting import save_figure
from quadjax.evaluation.curves import training_figure
from quadjax.evaluation.evaluate import Evaluation, evaluate, tabulate
from quadjax.evaluation.published import first_under, published_total
from quadjax.training.result import Run
from quadjax.training.score import no_lap


def write_evaluation(run: Run) -> str:
    """Evaluate the best policy of a run, and write its laps and the figures to the folder.

    Returns:
        The lap table, and steps, time, memory and the folder of the run, as text.
    """
    config, folder, metrics = run.config, run.folder, run.metrics
    published = published_total(config)
    results: dict[str, Evaluation] = {}
    for file, mean in (("laps", False), ("laps_deterministic", True)):
        result = evaluate(run.policy, config, deterministic=mean, name=str(folder / "policy.npz"))
        write_json(folder / f"{file}.json", result.to_json())
        results[result.label()] = result
    save_figure(result.plot(), folder / "trajectory.png")
    lines = [tabulate(results)]
    if len(metrics["steps"]):
        curves = training_figure({config.name: metrics}, config.name, published)
        save_figure(curves, folder / "curves.png")
    else:
        path = folder / "metrics.csv"
        lines.append(f"{path}: no rows, so there are no curves of the training")
    lines += _effort(run, published)
    if run.summary["best_lap_total"] is None:
        crashes = [why for result in results.values() for why in result.laps.crashes]
        lines.append(no_lap(crashes, run.summary["steps"]))
    return "\n".join(lines)


def _effort(run: Run, published: tuple[str, float] | None) -> list[str]:
    """Steps, time, memory and the folder of a run, and when it was under a published time."""
    summary, devices = run.summary, run.summary["devices"]
    memory = summary.get("peak_memory_mib")
    line = (
        f"trained {_amount(summary['steps'])} steps in {summary['seconds']:.0f} s on "
        f"{devices} device{'' if devices == 1 else 's'}"
    )
    lines = [line if memory is None else f"{line}, peak memory {memory:.0f} MiB"]
    if published and (first := first_under(run.metrics, published[1])):
        seconds, steps = first
        lines.append(
            f"the lap total was first under {published[1]:.2f} s after {seconds:.0f} s of training "
            f"({_amount(steps)} steps)"
        )
    return [*lines, f"policy, figures and metrics are in {run.folder}"]


def _amount(number: int) -> str:
    return f"{number / 1e6:.1f} million" if number >= 1e5 else f"{number:,}"
