"""What a finished training run shows: its lap table, its figures and where they are."""

from rich.console import Console

from quadjax.config.schema import Config
from quadjax.core.files import write_json
from quadjax.evaluation import tables
from quadjax.evaluation.curves import training_figure
from quadjax.evaluation.figures import flight_title, save_figure, trajectory_figure
from quadjax.evaluation.recording import choose, distinct, recordings
from quadjax.policy import pilot
from quadjax.training.metrics import read_metrics
from quadjax.training.run import Result


def present(config: Config, result: Result) -> None:
    """Fly the best policy, print its lap table and leave table and figures in the run's folder.

    Writes ``laps.json`` (the sampled laps, as ``quadjax evaluate --json`` does),
    ``laps_deterministic.json``, ``trajectory.png`` and ``curves.png``.
    """
    race = pilot.Race(config.evaluate.laps, config.evaluate.runs)
    with Console(stderr=True).status("timing laps and drawing"):
        sampled, _ = pilot.fly_policy(config, result.policy, race, False)
        steady, trace = pilot.fly_policy(config, result.policy, race, True, trace=True)
        write_json(result.directory / "laps.json", sampled.to_json())
        write_json(result.directory / "laps_deterministic.json", steady.to_json())
        shown = choose(distinct(recordings(trace, steady, config.episode.dt)))
        title = f"{config.name}: {flight_title(shown)}"
        figure = trajectory_figure([shown], config.track.gates, title)
        save_figure(figure, result.directory / "trajectory.png")
        metrics = {config.name: read_metrics(result.directory / "metrics.csv")}
        curves = training_figure(metrics, config.name, tables.published_total(config))
        save_figure(curves, result.directory / "curves.png")
    rows = [
        tables.lap_row(f"{config.name} sampled", sampled),
        tables.lap_row(f"{config.name} deterministic", steady),
    ]
    print(tables.format_table(rows, tables.published_rows(config, race.laps)))
    for laps, row in zip((sampled, steady), rows, strict=True):
        for line in tables.describe_crashes(laps).splitlines():
            print(f"{row.label}: {line}")
    print(_report(result))


def _report(result: Result) -> str:
    """What the run took and where its files are."""
    summary = result.summary
    first = summary["first_under"]
    devices = tables.counted(summary["devices"], "device")
    lines = [
        f"trained {summary['steps'] / 1e6:.1f} million steps in {summary['seconds']:.0f} s on "
        f"{devices}, {summary['peak_memory_mib']:.0f} MiB at most"
    ]
    if first and first["seconds"] is not None:
        lines.append(
            f"first under {first['total']:.2f} s after {first['seconds']:.0f} s and "
            f"{first['steps'] / 1e6:.1f} million steps"
        )
    return "\n".join([*lines, f"policy, figures and metrics are in {result.directory}"])
