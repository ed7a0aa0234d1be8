"""The lap table, the figures and the report of a finished training run."""

from rich.console import Console

from quadjax.core.files import write_json
from quadjax.evaluation import tables
from quadjax.evaluation.curves import training_figure
from quadjax.evaluation.figures import flight_title, save_figure, trajectory_figure
from quadjax.evaluation.recording import choose, distinct, recordings
from quadjax.policy import pilot
from quadjax.training.paper import published_rows, published_total
from quadjax.training.result import Run


def present(run: Run) -> None:
    """Evaluate the best policy, print its lap table and write table and figures to the folder.

    Writes ``laps.json`` (the sampled laps, as ``quadjax evaluate --json`` does),
    ``laps_deterministic.json``, ``trajectory.png`` and ``curves.png``.
    """
    config, folder = run.config, run.folder
    race = pilot.Race(config.evaluate.laps, config.evaluate.runs)
    with Console(stderr=True).status("timing laps and drawing"):
        sampled, _ = pilot.fly_policy(config, run.policy, race, False)
        steady, trace = pilot.fly_policy(config, run.policy, race, True, trace=True)
        write_json(folder / "laps.json", sampled.to_json())
        write_json(folder / "laps_deterministic.json", steady.to_json())
        shown = choose(distinct(recordings(trace, steady, config.episode.dt)))
        title = f"{config.name}: {flight_title(shown)}"
        save_figure(
            trajectory_figure([shown], config.track.gates, title), folder / "trajectory.png"
        )
        curves = training_figure({config.name: run.metrics}, config.name, published_total(config))
        save_figure(curves, folder / "curves.png")
    flown = {"sampled": sampled, "deterministic": steady}
    rows = [tables.lap_row(label, laps) for label, laps in flown.items()]
    print(tables.format_table(rows, published_rows(config, race.laps)))
    for label, laps in flown.items():
        for line in tables.describe_crashes(laps).splitlines():
            print(f"{label}: {line}")
    print(_report(run))


def _report(run: Run) -> str:
    """Steps, time, memory and the folder of a run, as text."""
    summary = run.summary
    first, memory = summary.get("first_under"), summary.get("peak_memory_mib")
    line = (
        f"trained {summary['steps'] / 1e6:.1f} million steps in {summary['seconds']:.0f} s on "
        f"{tables.counted(summary['devices'], 'device')}"
    )
    lines = [line if memory is None else f"{line}, {memory:.0f} MiB at most"]
    if first and first["seconds"] is not None:
        lines.append(
            f"first under {first['total']:.2f} s after {first['seconds']:.0f} s and "
            f"{first['steps'] / 1e6:.1f} million steps"
        )
    return "\n".join([*lines, f"policy, figures and metrics are in {run.folder}"])
