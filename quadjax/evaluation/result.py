"""What ``evaluate`` returns: rows of timed flights, as tables, figures, pages and files."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadjax.evaluation import figures
from quadjax.evaluation.conditions import Conditions
from quadjax.evaluation.rows import Row
from quadjax.evaluation.table import Format, condition_table, counted, lap_table, policy_table
from quadjax.flights.files import lap_times, save
from quadjax.flights.flight import Flight, distinct, fastest, numbered
from quadjax.race.laps import Laps


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed flights: a row for each policy and condition.

    ``laps``, ``flights``, ``best`` and the figures are those of the first row.

    Attributes:
        rows: policies one after the other, conditions in their order.
        protocol: how they were flown, and how the table looks.
        provenance: versions, config, policy, seed, date and device.
        by_condition: whether a list of conditions was flown.
        left_out: labels of conditions that the plant does not have.
        race: names of the drone and of the track, for titles.
    """

    rows: tuple[Row, ...]
    protocol: Conditions
    provenance: dict[str, Any]
    by_condition: bool = False
    left_out: tuple[str, ...] = ()
    race: str = ""

    def __repr__(self) -> str:
        """One line, of each row: policy, condition, how many runs finished."""
        rows = (
            f"{' '.join(filter(None, (row.policy, row.condition)))}: "
            f"{row.laps.finished}/{len(row.laps.totals)} finished"
            for row in self.rows
        )
        return f"Evaluation({', '.join(rows)})"

    def __getitem__(self, label: str) -> Row:
        """The first row of a condition, by its label."""
        return next(row for row in self.rows if row.condition == label)

    @property
    def row(self) -> Row:
        """The first row."""
        return self.rows[0]

    @property
    def laps(self) -> Laps:
        """Lap times, totals and crashes of all runs."""
        return self.row.laps

    @property
    def lap_times(self) -> np.ndarray:
        """Lap times (runs, laps), s; NaN for laps that were not completed."""
        return self.laps.lap_times

    @property
    def totals(self) -> np.ndarray:
        """Time of all laps of each run (runs,), s; NaN for runs that did not finish."""
        return self.laps.totals

    @property
    def finished(self) -> int:
        """Number of runs that completed every lap."""
        return self.laps.finished

    @functools.cached_property
    def flights(self) -> list[Flight]:
        """Every run as a flight; of flights on the plant one of each of the first drones."""
        facts = {"race": self.race} if self.race else {}
        return [flight.replace(source=flight.source | facts) for flight in self.row.record()]

    @property
    def title(self) -> str:
        """The policy, the drone and the track of the first row."""
        return ": ".join(filter(None, (self.row.policy, self.race)))

    @property
    def best(self) -> Flight:
        """The fastest of the recorded runs, or the longest if none finished."""
        return fastest(self.flights)

    def named_flights(self, name: str) -> list[Flight]:
        """The distinct runs, named for a page, and the published lap times of the same race."""
        runs = distinct(self.flights)
        actions = "deterministic" if self.protocol.deterministic else "sampled"
        flights = [
            run.replace(name=label, source=run.source | {"note": f"{flight_title(run)}, {actions}"})
            for label, run in zip(numbered(name, len(runs)), runs, strict=True)
        ]
        published = self.row.published
        return flights + ([lap_times(published.policy, published.lap_means)] if published else [])

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m.

        The larger of the lateral and the vertical one.
        """
        distances = [np.zeros(0)]
        for flight in self.flights:
            when, passed = flight.passages[:, 0], flight.passages[:, 1].astype(int)
            path = [np.interp(when, flight.time, column) for column in flight["position"].T]
            center = np.array([gate.position for gate in flight.gates])[passed]
            axes = np.array([gate.axes for gate in flight.gates])[passed]
            place = np.einsum("ni,nij->nj", np.stack(path, axis=1) - center, axes)
            distances.append(np.abs(place[:, 1:]).max(axis=1))
        return np.concatenate(distances)

    def table(self, format: Format | None = None) -> str:
        """The rows as a table, by default as Markdown with conditions and as text without.

        Without conditions it is the lap table, with the published row of the same race and
        protocol, if any.
        """
        columns = self.protocol.columns
        if not self.by_condition and self.protocol.seconds is None:
            table = lap_table(self.rows)
        elif not self.by_condition:
            table = condition_table(self.rows, "", ("crashed", "ended"))
        elif self.protocol.across:
            table = policy_table(self.rows, columns[0])
        else:
            table = condition_table(self.rows, self.protocol.title, columns)
        if self.left_out:
            note = f"Not flown on the plant, which has no such start: {'; '.join(self.left_out)}."
            table = dataclasses.replace(table, notes=[*table.notes, note])
        return table.format(format or ("markdown" if self.by_condition else "text"))

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        return self.figures()["trajectory"]

    def figures(self) -> dict[str, Figure]:
        """Figures of the best run by name: ``trajectory``, ``perspective`` and ``signals``."""
        best, title = self.best, f"{self.title}\n{flight_title(self.best)}"
        return {
            "trajectory": figures.trajectory_figure([best], best.gates, title),
            "perspective": figures.space_figure([best], best.gates, title),
            "signals": figures.signals_figure(best, title),
        }

    def show(self, path: Path | str | None = None) -> None:
        """Show the runs in 3D: in a notebook, or as a page in the browser.

        Args:
            path: of the page, an HTML file that needs no network; a temporary file if not given.
        """
        from quadjax.view.data import page_record
        from quadjax.view.page import show

        title = f"{self.title}; {self.row.condition}"
        show(page_record(title, self.named_flights("run")), path)

    def save_states(self, path: Path | str) -> None:
        """Write all runs, as arrays (``.npz``) or as a table (``.csv``); see ``flights.files``.

        The metadata of the arrays have the entries of ``to_json``, too.

        Raises:
            InputError: another suffix.
        """
        save(self.flights, path, **self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Lap times in s, crashes, how the runs were made, and their provenance; or the rows."""
        protocol, record = self.protocol, {"provenance": self.provenance}
        if not self.by_condition:
            actions = {"deterministic": bool(protocol.deterministic)}
            return self.laps.to_json() | actions | {"start": protocol.start} | record
        rows = {"flights": [row.to_json() for row in self.rows]}
        return rows | ({"seconds": protocol.seconds} if protocol.seconds else {}) | record


def flight_title(flight: Flight) -> str:
    """Laps, time and crash of a flight as a short text."""
    title = f"{counted(len(flight.lap_ends), 'lap')} in {flight.time[-1]:.2f} s"
    return f"{title}, then {flight.crash}" if flight.crash else title


def merge_evaluations(evaluations: Sequence[Evaluation]) -> Evaluation:
    """The rows of several evaluations of one race: of policies, or of one with other actions.

    Policies of one label have their files as labels.
    """
    files = {result.provenance["policy"]["file"]: result.row.policy for result in evaluations}
    labels = Counter(files.values())
    rows = [
        row if labels[row.policy] == 1 else dataclasses.replace(row, policy=file)
        for result in evaluations
        for file in [result.provenance["policy"]["file"]]
        for row in result.rows
    ]
    return dataclasses.replace(evaluations[0], rows=tuple(rows))
