"""Tables and figures of groups of flights, as a paper has them, in a folder."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.evaluation.charts import Response, box_figure, error_figure, gap_figure, response
from quadjax.evaluation.figures import Groups, trajectory_figure
from quadjax.evaluation.table import flights_table
from quadjax.flights.flight import Flight, fastest

FORMATS = ("pdf", "svg", "png")
FILES = (
    *("table.txt", "table.tex", "report.json"),
    *("boxes.*", "gaps.*", "trajectories.*", "errors_*.*"),
    *("architectures.*", "toolchain.*"),  # of earlier versions
)


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
    table = flights_table(groups)
    write_text(folder / "table.txt", table.format("text") + "\n")
    write_text(folder / "table.tex", table.format("latex") + "\n")
    record = {label: [_numbers(flight) for flight in flights] for label, flights in groups.items()}
    write_json(folder / "report.json", {"groups": record, "provenance": provenance(config)})
    for name, figure in report_figures(groups, config):
        for suffix in FORMATS:
            save_figure(figure, folder / f"{name}.{suffix}")
    return table.format("text")


def _numbers(flight: Flight) -> dict[str, object]:
    """Times of laps and gates, s, and the crash of a flight."""
    times = {"laps": flight.lap_times, "gates": flight.passages[:, 0]}
    rounded = {key: np.round(values, 4).tolist() for key, values in times.items()}
    return {"name": flight.name, **rounded, "crash": flight.crash or ""}


def report_figures(groups: Groups, config: Config) -> Iterator[tuple[str, Figure]]:
    """Every figure of a report, by name."""
    gates, labels = config.track.gates, list(groups)
    yield "boxes", box_figure(groups)
    yield "gaps", gap_figure(groups, len(gates))
    yield "trajectories", trajectory_figure(groups, gates)
    for label, (best, signals) in fastest_responses(groups, config).items():
        title = f"{label}, {best.name}"
        yield f"errors_{labels.index(label) + 1}", error_figure(best, signals, len(gates), title)


def fastest_responses(groups: Groups, config: Config) -> dict[str, tuple[Flight, Response]]:
    """The fastest flight of each group with its ``response``, by label, where there is one."""
    best = {label: fastest(flights) for label, flights in groups.items()}
    signals = {label: response(flight, config.vehicle) for label, flight in best.items()}
    return {label: (best[label], found) for label, found in signals.items() if found is not None}
