"""What a finished training run shows: its lap table, its figures and where they are."""

from rich.console import Console

from quadjax.evaluate import pilot, tables
from quadjax.evaluate.curves import read_metrics, training_figure
from quadjax.evaluate.figures import save_figure, trajectory_figure
from quadjax.evaluate.recording import choose, distinct, recordings
from quadjax.files import write_json
from quadjax.schema import Config
from quadjax.training import FLYING_TOTAL, Result


def present(config: Config, result: Result) -> None:
    """Fly the best policy, print its lap table and leave table and figures in the run's folder.

    Writes ``laps.json`` (the sampled and the deterministic laps), ``trajectory.png`` and
    ``curves.png``.
    """
    race = pilot.Race(config.evaluate.laps, config.evaluate.runs)
    with Console(stderr=True).status("timing laps and drawing"):
        sampled, _ = pilot.fly_policy(config, result.policy, race, False)
        steady, trace = pilot.fly_policy(config, result.policy, race, True, trace=True)
        write_json(
            result.directory / "laps.json",
            {"sampled": sampled.to_json(), "deterministic": steady.to_json()},
        )
        shown = choose(distinct(recordings(trace, steady, config.episode.dt)))
        title = f"{config.name}: {len(shown.lap_ends)} laps in {shown.time[-1]:.2f} s"
        figure = trajectory_figure([shown], config.track.gates, title)
        save_figure(figure, result.directory / "trajectory.png")
        metrics = {config.name: read_metrics(result.directory / "metrics.csv")}
        published = ("published E2E policy", FLYING_TOTAL)
        curves = training_figure(metrics, config.name, published)
        save_figure(curves, result.directory / "curves.png")
    rows = [
        tables.lap_row(f"{config.name} sampled", sampled),
        tables.lap_row(f"{config.name} deterministic", steady),
    ]
    print(tables.format_table(rows, tables.published_rows(config.track, race.laps)))
    print(_report(result))


def _report(result: Result) -> str:
    """What the run took and where its files are."""
    summary = result.summary
    first = summary["first_under_15.70"]
    lines = [
        f"trained {summary['steps'] / 1e6:.1f} million steps in {summary['seconds']:.0f} s on "
        f"{summary['devices']} devices, {summary['peak_memory_mib']:.0f} MiB at most"
    ]
    if first:
        lines.append(
            f"first under {FLYING_TOTAL:.2f} s after {first['seconds']:.0f} s and "
            f"{first['steps'] / 1e6:.1f} million steps"
        )
    return "\n".join([*lines, f"policy, figures and metrics are in {result.directory}"])
