"""A report of groups of flights, as a paper has it: tables, boxes, gaps and command errors."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.plotting import INK, MUTED, PAPER, headline, new_figure, save_figure, tidy
from quadjax.core.provenance import provenance
from quadjax.evaluation.figures import MAX_DRAWN_FLIGHTS, Groups, choose_colors, trajectory_figure
from quadjax.evaluation.responses import Response, error_figure, response
from quadjax.evaluation.table import Format, counted, flights_table
from quadjax.flights.flight import Flight, fastest
from quadjax.race.track import GateSection

FORMATS = ("pdf", "svg", "png")
FILES = (
    *("table.txt", "table.tex", "report.json"),
    *("boxes.*", "gaps.*", "trajectories.*", "errors_*.*"),
)
STYLES = ("-", "--", "-.", ":")


@dataclasses.dataclass(frozen=True)
class Report:
    """Groups of flights next to each other: the tables and figures of a paper.

    Attributes:
        groups: flights by the label of their group, as ``evaluate(..).flights`` returns them.
        config: the race of flights without gates of their own, or constants of their drone.
    """

    groups: Groups
    config: Config
    note: str = ""  # which flights these are, for titles and the table

    def __repr__(self) -> str:
        """The groups in one line."""
        counts = (f"{label}: {len(flights)} flights" for label, flights in self.groups.items())
        return f"Report({', '.join(counts)})"

    @property
    def gates(self) -> Sequence[GateSection]:
        """Of the track that all flights fly.

        Raises:
            InputError: flights on different tracks.
        """
        flown = {f.gates: label for label, flights in self.groups.items() for f in flights}
        flown.pop((), None)
        if len(flown) > 1:
            pair = " and ".join(list(flown.values())[:2])
            raise InputError(f"{pair}: flights on different tracks, allowed: flights on one track")
        return next(iter(flown), self.config.track.gates)

    def table(self, format: Format = "text") -> str:
        """Laps and total of each flight; the fastest of its group is highlighted."""
        table = flights_table(self.groups)
        notes = [*table.notes, *filter(None, [self.note])]
        return dataclasses.replace(table, notes=notes).format(format)

    def boxes(self) -> Figure:
        """Box plots of lap 1 and, if there are more, of the later laps and the total, by group.

        Boxes from the first to the third quartile with the median, whiskers to the last flight
        within 1.5 times their range, and a dot for each flight. Flights that did not finish count
        in the laps that they completed.
        """
        colors, names = choose_colors(self.groups), list(self.groups)
        count = max(len(f.lap_times) for flights in self.groups.values() for f in flights)
        columns: dict[str, list[Sequence[float]]] = {
            "lap 1 (s)": [[t for f in v for t in f.lap_times[:1]] for v in self.groups.values()],
        }
        if count > 1:
            later = f"laps 2 to {count} (s)" if count > 2 else "lap 2 (s)"
            columns |= {
                later: [[t for f in v for t in f.lap_times[1:]] for v in self.groups.values()],
                f"total of {count} laps (s)": [
                    [f.total for f in v if len(f.lap_times) == count and np.isfinite(f.total)]
                    for v in self.groups.values()
                ],
            }
        figure = new_figure(9.6, 1.1 + 0.5 * len(self.groups))
        panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
        for axes, (label, times) in zip(panels, columns.items(), strict=True):
            tidy(axes)
            axes.grid(False, axis="y")
            style: dict[str, Any] = {"widths": 0.5, "showfliers": False, "patch_artist": True}
            style |= {"orientation": "horizontal", "manage_ticks": False}
            boxes = axes.boxplot(times, **style)
            for index, (name, values) in enumerate(zip(names, times, strict=True)):
                boxes["boxes"][index].set(facecolor=PAPER, edgecolor=colors[name])
                boxes["medians"][index].set(color=colors[name], lw=2.2)
                jitter = 0.12 * np.sin(2.4 * np.arange(len(values)))  # equal times do not cover
                axes.plot(values, index + 1 + jitter, "o", ms=3, color=colors[name], alpha=0.6)
            axes.set_xlabel(label, color=INK)
            axes.margins(x=0.08)
        panels[0].set_yticks(range(1, len(self.groups) + 1), names)
        panels[0].set_ylim(len(self.groups) + 0.6, 0.4)
        headline(figure, self.title)
        return figure

    def gaps(self) -> Figure:
        """Time behind the flight that is first at each gate, of all flights.

        The first is that of the flights that pass the most gates: one that crashed may have been
        ahead.
        """
        colors, gates = choose_colors(self.groups), len(self.gates)
        figure = new_figure(9.6, 4.2)
        axes = figure.add_subplot()
        tidy(axes)
        every = [flight.passages[:, 0] for flights in self.groups.values() for flight in flights]
        count = max(map(len, every))
        leader = np.min([times for times in every if len(times) == count], axis=0)
        for index, (group, flights) in enumerate(self.groups.items()):
            few = len(flights) <= MAX_DRAWN_FLIGHTS
            style: dict[str, Any] = {"color": colors[group], "lw": 1.8 if few else 0.8}
            style |= {"alpha": 1.0 if few else 0.5}
            line = STYLES[index % len(STYLES)] if len(flights) == 1 else "-"
            for number, flight in enumerate(flights):
                behind = flight.passages[:, 0] - leader[: len(flight.passages)]
                label = f"{group} ({counted(len(flights), 'flight')})" if number == 0 else None
                axes.plot(np.arange(len(behind)) + 1, behind, line, label=label, **style)
                if flight.crash and len(behind):
                    axes.plot(len(behind), behind[-1], "x", color=colors[group], ms=8, mew=2)
        for lap in range(gates, count + 1, gates):
            axes.axvline(lap, color=MUTED, lw=0.9, ls="--", zorder=0)
        axes.set_xlim(1, count + 0.15)
        ahead = any(np.any(times < leader[: len(times)]) for times in every)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]) if ahead else 0.0)
        axes.set_xlabel("gate; dashed: the end of a lap", color=INK)
        axes.set_ylabel("behind the first at each gate (s)", color=INK)
        axes.set_title(self.title, color=INK, fontsize=13, loc="left")
        figure.legend(loc="outside upper left", ncols=4, frameon=False, labelcolor=INK, fontsize=9)
        return figure

    def trajectories(self) -> Figure:
        """From above and from the side, groups next to each other, colored by speed."""
        figure = trajectory_figure(self.groups, self.gates)
        headline(figure, self.title)
        return figure

    def responses(self) -> dict[str, tuple[Flight, Response]]:
        """The fastest flight of each group with its ``response``, by label, where there is one."""
        best = {label: fastest(flights) for label, flights in self.groups.items()}
        signals = {label: response(flight, self.config.vehicle) for label, flight in best.items()}
        return {label: (best[label], x) for label, x in signals.items() if x is not None}

    def errors(self, label: str) -> Figure:
        """Commands, limits and errors of the fastest flight of a group over time.

        The signals are propeller speeds, or body rates and thrust. The error is the difference from
        the first-order response to the commands, with the constants of the drone that flew.

        Raises:
            InputError: no such group, or the vehicle has no model of the commands of its fastest
                flight.
        """
        if label not in self.groups:
            raise InputError(f"{label}: no group of flights, allowed: {', '.join(self.groups)}")
        responses = self.responses()
        if label not in responses:
            raise InputError(f"{label}: the vehicle has no model of its commands")
        best, signals = responses[label]
        return error_figure(best, signals, len(self.gates), f"{label}, {best.name}")

    @property
    def title(self) -> str:
        """The drone and the track of all flights, or those of the config."""
        races = {f.source.get("race") for flights in self.groups.values() for f in flights}
        own = f"{self.config.vehicle.name}, {self.config.track.name}"
        named = str(races.pop() or own) if len(races) == 1 else own
        return "; ".join(filter(None, (named, self.note)))

    def figures(self) -> Iterator[tuple[str, Figure]]:
        """Every figure by name: ``boxes``, ``gaps``, ``trajectories``, ``errors_N`` of group N."""
        yield "boxes", self.boxes()
        yield "gaps", self.gaps()
        yield "trajectories", self.trajectories()
        for label in self.responses():
            yield f"errors_{list(self.groups).index(label) + 1}", self.errors(label)

    def write(self, folder: Path) -> str:
        """Write tables and figures; returns the table as text.

        ``table.txt``, ``table.tex``, ``report.json``, and ``figures`` as PDF, SVG and PNG.

        Raises:
            InputError: no lap in any flight, or a file that cannot be written.
        """
        if not any(len(f.lap_times) for flights in self.groups.values() for f in flights):
            raise InputError("no flight completes a lap, so there is nothing to report")
        write_text(folder / "table.txt", self.table("text") + "\n")
        write_text(folder / "table.tex", self.table("latex") + "\n")
        record = {label: [*map(_numbers, flights)] for label, flights in self.groups.items()}
        content = {"groups": record, "provenance": provenance(self.config)}
        write_json(folder / "report.json", content)
        for name, figure in self.figures():
            save_figure(figure, *(folder / f"{name}.{suffix}" for suffix in FORMATS))
        return self.table("text")


def _numbers(flight: Flight) -> dict[str, object]:
    """Times of laps and gates, s, and the crash of a flight."""
    times = {"laps": flight.lap_times, "gates": flight.passages[:, 0]}
    rounded = {key: np.round(values, 4).tolist() for key, values in times.items()}
    return {"name": flight.name, **rounded, "crash": flight.crash or ""}
