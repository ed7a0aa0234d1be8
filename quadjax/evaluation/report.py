"""Tables and figures of groups of flights, as a paper has them, in a folder."""

import dataclasses
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
from quadjax.evaluation.table import Format, flights_table
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


@dataclasses.dataclass(frozen=True)
class Report:
    """Groups of flights next to each other: the tables and figures of a paper.

    Attributes:
        groups: flights by the label of their group, as ``evaluate(..).flights`` returns them.
        config: of the race: its track, and the constants of its vehicle.
    """

    groups: Groups
    config: Config

    def table(self, format: Format = "text") -> str:
        """Laps and total of each flight; the fastest of its group stands out."""
        return flights_table(self.groups).format(format)

    def boxes(self) -> Figure:
        """Box plots of lap 1, of the later laps and of the total."""
        return box_figure(self.groups)

    def gaps(self) -> Figure:
        """Time behind the first flight at each gate, all flights."""
        return gap_figure(self.groups, len(self.config.track.gates))

    def trajectories(self) -> Figure:
        """From above and from the side, groups next to each other, colored by speed."""
        return trajectory_figure(self.groups, self.config.track.gates)

    def errors(self, label: str) -> Figure:
        """Commands, limits and errors of the fastest flight of a group over time.

        Of the rotors' speeds, or of body rates and thrust: the difference from the first-order
        response to the commands, with the constants of the config's vehicle.

        Raises:
            InputError: the vehicle has no model of the commands of the group's fastest flight.
        """
        found = fastest_responses(self.groups, self.config).get(label)
        if found is None:
            raise InputError(f"{label}: the vehicle has no model of its commands")
        best, signals = found
        gates = len(self.config.track.gates)
        return error_figure(best, signals, gates, f"{label}, {best.name}")


def report_figures(groups: Groups, config: Config) -> Iterator[tuple[str, Figure]]:
    """Every figure of a report, by name."""
    report, labels = Report(groups, config), list(groups)
    yield "boxes", report.boxes()
    yield "gaps", report.gaps()
    yield "trajectories", report.trajectories()
    for label in fastest_responses(groups, config):
        yield f"errors_{labels.index(label) + 1}", report.errors(label)


def fastest_responses(groups: Groups, config: Config) -> dict[str, tuple[Flight, Response]]:
    """The fastest flight of each group with its ``response``, by label, where there is one."""
    best = {label: fastest(flights) for label, flights in groups.items()}
    signals = {label: response(flight, config.vehicle) for label, flight in best.items()}
    return {label: (best[label], found) for label, found in signals.items() if found is not None}
