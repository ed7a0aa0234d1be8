"""The result of an evaluation: flights, rows, tables and figures."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadjax.evaluation import charts, figures
from quadjax.evaluation.conditions import Conditions
from quadjax.evaluation.protocol import Protocol
from quadjax.evaluation.rows import Row
from quadjax.evaluation.table import (
    Format,
    condition_table,
    counted,
    flight_title,
    lap_table,
    policy_table,
)
from quadjax.flights.files import lap_times, save
from quadjax.flights.flight import Flight, distinct, fastest
from quadjax.race.laps import Laps
from quadjax.race.track import GateSection

Record = Callable[[], list[Flight]]


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Timed flights of a policy under one condition.

    Attributes:
        row: the flights, with the labels of the policy and the condition.
        protocol: how they were flown.
        gates: of the track, in order of passage.
        time_step: of the simulation, s.
        provenance: versions, config, policy, seed, date and device.
        record: the recorded flights; a simulation is repeated to record it.
    """

    row: Row
    protocol: Protocol
    gates: Sequence[GateSection]
    time_step: float
    provenance: dict[str, Any]
    record: Record = dataclasses.field(repr=False)

    @property
    def deterministic(self) -> bool:
        """Whether the mean action was applied, not samples."""
        return self.protocol.deterministic

    @property
    def start(self) -> str:
        """Where the flights start; see ``evaluate``."""
        return self.protocol.start

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
        """Every run as a flight; of flights on the plant the first of each plant."""
        return self.record()

    @property
    def best(self) -> Flight:
        """The fastest of the recorded runs, or the longest if none finished."""
        return fastest(self.flights)

    def shown(self, name: str) -> list[Flight]:
        """The distinct runs, named for a page, and the published lap times of the same race."""
        runs = distinct(self.flights)
        actions = "deterministic" if self.deterministic else "sampled"
        flights = [
            run.replace(
                name=name if len(runs) == 1 else f"{name} {number}",
                source=run.source | {"note": f"{flight_title(run)}, {actions}"},
            )
            for number, run in enumerate(runs, start=1)
        ]
        beside = self.row.beside
        return flights + ([lap_times(beside.policy, beside.lap_means)] if beside else [])

    @property
    def gate_offsets(self) -> np.ndarray:
        """Distance from the gate's center of every passage of all runs (n,), m."""
        return np.concatenate([_gate_offsets(flight) for flight in self.flights])

    def label(self) -> str:
        """How the actions were chosen, and the number of runs."""
        how = "deterministic" if self.deterministic else "sampled"
        return f"{how}, {counted(self.row.runs, 'run')}"

    def table(self, format: Format = "text") -> str:
        """The lap table, with the published row of the same race and protocol, if any."""
        return tabulate({self.label(): self}, format)

    def plot(self) -> Figure:
        """The best run seen from above and from the side, colored by speed."""
        return figures.trajectory_figure([self.best], self.gates, flight_title(self.best))

    def plot_signals(self) -> Figure:
        """Actuators and body rates of the best run over time."""
        return charts.signals_figure(self.best, flight_title(self.best))

    def plot_3d(self) -> Figure:
        """The best run in perspective, colored by speed."""
        return figures.space_figure([self.best], self.gates, flight_title(self.best))

    def plot_attitude(self) -> Figure:
        """Height, speed and Euler angles of the best run over time."""
        return charts.attitude_figure({"": self.best}, flight_title(self.best))

    def show(self, path: Path | str | None = None) -> None:
        """Show the runs in 3D: in a notebook, or as a page in the browser.

        Args:
            path: of the page, an HTML file that needs no network; a temporary file if not given.
        """
        from quadjax.view.data import page_record
        from quadjax.view.notebook import show

        show(page_record(self.label(), self.shown("run")), path)

    def animate(self, path: Path | str, advance: Callable[[], object] = lambda: None) -> None:
        """Write an animation of all runs in real time.

        Args:
            path: a ``.gif`` file.
            advance: called after every frame.
        """
        from quadjax.evaluation.animation import write_animation

        write_animation(distinct(self.flights), self.gates, path, advance)

    def save_states(self, path: Path | str) -> None:
        """Write all runs, as arrays (``.npz``) or as a table (``.csv``); see ``flights.files``.

        The metadata of the arrays have the entries of ``to_json``, too.

        Raises:
            InputError: another suffix.
        """
        save(self.flights, path, **self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Lap times in s, crashes, how the runs were made, and their provenance."""
        return self.laps.to_json() | {
            "deterministic": self.deterministic,
            "start": self.start,
            "provenance": self.provenance,
        }


@dataclasses.dataclass(frozen=True)
class Evaluations:
    """Flights of one or several policies under conditions.

    Attributes:
        conditions: the list, which says how the table looks.
        protocol: how the flights are flown.
        results: policies one after the other, conditions in their order.
    """

    conditions: Conditions
    protocol: Protocol
    results: tuple[Evaluation, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """One row for each policy and condition."""
        return tuple(result.row for result in self.results)

    def __getitem__(self, label: str) -> Evaluation:
        """The first result under a condition, by its label."""
        return next(result for result in self.results if result.row.condition == label)

    def table(self, format: Format = "markdown") -> str:
        """The rows with the columns of the list."""
        if self.conditions.across:
            return policy_table(self.rows, self.conditions.columns[0]).format(format)
        columns = self.conditions.columns
        return condition_table(self.rows, self.conditions.title, columns).format(format)

    def to_json(self) -> dict[str, Any]:
        """The rows, and the provenance of the first result."""
        first = self.results[0]
        record: dict[str, Any] = {"flights": [row.to_json() for row in self.rows]}
        if self.protocol.seconds is not None:
            record["seconds"] = self.protocol.seconds
        return record | {"provenance": first.provenance}


def joined(evaluations: Iterable[Evaluations]) -> Evaluations:
    """The results of several policies under the same conditions.

    Policies of one label have their files as labels.
    """
    every = list(evaluations)
    labels = [each.results[0].row.policy for each in every]
    results = []
    for result in (result for each in every for result in each.results):
        if labels.count(result.row.policy) > 1:
            row = dataclasses.replace(result.row, policy=result.provenance["policy"]["file"])
            result = dataclasses.replace(result, row=row)
        results.append(result)
    return dataclasses.replace(every[0], results=tuple(results))


def _gate_offsets(flight: Flight) -> np.ndarray:
    """The larger of the lateral and the vertical distance of each passage (n,), m."""
    gates = [flight.gates[int(index)] for index in flight.passages[:, 1]]
    when = flight.passages[:, 0]
    path = [np.interp(when, flight.time, column) for column in flight["position"].T]
    center = np.array([gate.position for gate in gates], np.float64).reshape(-1, 3)
    axes = np.array([gate.axes for gate in gates]).reshape(-1, 3, 3)
    place = np.einsum("ni,nij->nj", np.stack(path, axis=1) - center, axes)
    return np.abs(place[:, 1:]).max(axis=1)


def tabulate(evaluations: Mapping[str, Evaluation], format: Format = "text") -> str:
    """Evaluations of one race by label as one lap table, with how runs ended early."""
    rows = [
        dataclasses.replace(result.row, policy=label, condition="")
        for label, result in evaluations.items()
    ]
    if any(result.protocol.seconds is not None for result in evaluations.values()):
        timed = [dataclasses.replace(row, policy="", condition=row.policy) for row in rows]
        return condition_table(timed, "", ("crashed", "ended")).format(format)
    beside = {row.row.beside for row in evaluations.values() if not row.deterministic}
    published = [row for row in beside if row is not None] if len(beside) == 1 else []
    return lap_table([*rows, *published]).format(format)
