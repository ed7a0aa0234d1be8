"""Write the tables and figures of a report."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.flights.flight import Flight, fastest
from quadjax.studies.report.errors import (
    RATES,
    RPM,
    Signals,
    commands_of,
    error_figure,
    signals_of,
)
from quadjax.studies.report.figures import box_figure, gap_figure, trajectory_figure
from quadjax.studies.report.tables import latex_table, text_table

FORMATS = ("pdf", "svg", "png")
FILES = (
    *("table.txt", "table.tex", "report.json"),
    *("boxes.*", "gaps.*", "trajectories.*", "errors_*.*"),
    *("architectures.*", "toolchain.*"),  # of earlier versions
)
MODELS = {RPM: "motor", RATES: "rate"}
Groups = Mapping[str, Sequence[Flight]]


def write_report(groups: Groups, config: Config, folder: Path) -> str:
    """Write tables and figures of groups of flights; returns the table as text.

    ``table.txt``, ``table.tex``, ``report.json``, and as PDF, SVG and PNG ``boxes``, ``gaps``,
    ``trajectories``, and ``errors_N`` of each group's fastest flight.

    Args:
        groups: flights by the label of their group.
        config: of the race: its track, and the constants of its vehicle.
        folder: to write to.

    Raises:
        InputError: no lap in any flight, or a file that cannot be written.
    """
    if not any(len(f.lap_times) for flights in groups.values() for f in flights):
        raise InputError("no flight completes a lap, so there is nothing to report")
    text = text_table(groups)
    write_text(folder / "table.txt", text + "\n")
    write_text(folder / "table.tex", latex_table(groups) + "\n")
    write_json(folder / "report.json", _numbers(groups) | {"provenance": provenance(config)})
    for name, figure in figures(groups, config):
        for suffix in FORMATS:
            save_figure(figure, folder / f"{name}.{suffix}")
    return text


def figures(groups: Groups, config: Config) -> Iterator[tuple[str, Figure]]:
    """Every figure of a report, by name."""
    gates = config.track.gates
    yield "boxes", box_figure(groups)
    yield "gaps", gap_figure(groups, len(gates))
    yield "trajectories", trajectory_figure(groups, gates)
    labels = list(groups)
    for label, (best, signals) in fastest_signals(groups, config).items():
        yield f"errors_{labels.index(label) + 1}", error_figure(label, best, signals)


def fastest_signals(groups: Groups, config: Config) -> dict[str, tuple[Flight, Signals]]:
    """The fastest flight of each group that has commands, and its signals, by label.

    Without the groups whose vehicle model the config's vehicle has no constants of.
    """
    signals, models = {}, (config.vehicle.model, *config.vehicle.models)
    for label, flights in groups.items():
        best = fastest(flights)
        kind = commands_of(best)
        if MODELS.get(kind) in models:
            model = config.vehicle.with_model(MODELS[kind])
            signals[label] = best, signals_of(best, model.constants)
    return signals


def _numbers(groups: Groups) -> dict[str, object]:
    """Lap times, s, of every flight."""
    return {
        "groups": {
            group: [
                {
                    "name": flight.name,
                    "laps": [round(float(x), 4) for x in flight.lap_times],
                    "gates": [round(float(x), 4) for x in flight.passages[:, 0]],
                    "crash": flight.crash or "",
                }
                for flight in flights
            ]
            for group, flights in groups.items()
        }
    }
