"""What ``compare`` returns: flights of E2E and INDI as tables, leads, a figure and numbers."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from quadjax.core.plotting import INK, MUTED, SERIES, head, new_figure, tidy
from quadjax.evaluation.leads import Interval, Leads, leads, twice_the_mean
from quadjax.evaluation.rows import Row, concatenate
from quadjax.evaluation.table import Format, Table, lap_table, number

SIMULATED, PLANT = "simulated", "plant"  # labels of the worlds without conditions
PANELS = "total (s)", "lap", "drone, total of all laps"
STYLED = ("boxprops", "whiskerprops", "capprops", "medianprops")


class World(NamedTuple):
    """Flights of both contenders in the simulator, on the plant, or under one condition."""

    rows: list[Row]  # of each, with the flights of all trainings
    laps: list[np.ndarray]  # of each: lap times (drones, trainings, flights, laps), s
    failed_after: float  # s that count for a flight that does not finish, in the score
    leads: Leads  # of E2E


def world(
    label: str, names: Sequence[str], sides: Sequence[Sequence[Row]], failed_after: float | None
) -> World:
    """The flights of both contenders, from the rows of their trainings; see ``compare``."""
    rows, laps = [], []
    for name, trainings in zip(names, sides, strict=True):
        times = [row.laps.lap_times for row in trainings]
        shape = trainings[0].drones, -1, times[0].shape[1]
        laps.append(np.stack([x.reshape(shape) for x in times], axis=1))
        every = concatenate([row.laps for row in trainings])
        actions = trainings[0].condition.partition(",")[0]  # sampled or deterministic
        share = float(np.mean([row.at_limit for row in trainings]))
        condition = "" if actions == label else actions
        rows.append(Row(f"{name} {label}", every, condition, at_limit=share))
    first, second = laps
    after = twice_the_mean(first, second) if failed_after is None else failed_after
    return World(rows, laps, after, leads(first, second, after))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """E2E and INDI in several worlds.

    Attributes:
        names: of E2E and of INDI.
        worlds: "simulated" and "plant", or the conditions, by label.
        by_condition: whether a list of conditions was flown.
        provenance: versions, plant, policies and their races, seed, date and device.
    """

    names: tuple[str, str]
    worlds: Mapping[str, World]
    by_condition: bool
    provenance: dict[str, Any]

    def __repr__(self) -> str:
        """One line, with the lead in each world."""
        found = ", ".join(f"{label} {x.leads.total} s" for label, x in self.worlds.items())
        return f"Comparison({self.title}: {found})"

    @property
    def title(self) -> str:
        """Whose lead it is, and over whom."""
        return "{}'s lead over {}".format(*self.names)

    def table(self, format: Format = "text") -> str:
        """Laps, total, finished flights and score; with conditions a line for each of them."""
        worlds = self.worlds.values()
        laps = lap_table([row for world in worlds for row in world.rows])
        notes = list(laps.notes)
        if self.by_condition:
            titles = ["", *(x for name in self.names for x in (name, "finished", "score")), "lead"]
            lines = [[label, *_cells(world)] for label, world in self.worlds.items()]
        else:
            titles = [*laps.titles, "score"]
            scores = [number(score) for world in worlds for score in world.leads.scores]
            lines = [[*line, score] for line, score in zip(laps.rows, scores, strict=True)]
            shares = [(row.policy, row.at_limit) for world in worlds for row in world.rows]
            texts = [f"{name} {100 * x:.0f}%" for name, x in shares if np.isfinite(x)]
            notes += [f"motor commands at a limit: {', '.join(texts)}"] * bool(texts)
        failed = [world.failed_after for world in worlds]
        counts = " to ".join(number(x, unit=" s") for x in sorted({min(failed), max(failed)}))
        notes.append(f"score: mean of all flights; one that does not finish counts as {counts}")
        return Table(titles, lines, notes).format(format)

    def lead(self, format: Format = "text") -> str:
        """By how much E2E is faster: total, first lap, each later lap and score, by world."""
        lines, over = [], dict[str, list[str]]()
        for label, (*_, x) in self.worlds.items():
            times = map(str, (x.total, x.laps[0], x.later, x.score))
            lines.append([label, *times, f"{x.pairs}/{x.of}"])
            if np.isfinite(x.score.low):
                over.setdefault(x.over, []).append(label)
        titles = [self.title, "total", "first lap", "each later lap", "score", "both finish"]
        notes = ["seconds; times of the pairs of flights that both finish, score of all flights"]
        for levels, labels in over.items():
            where = f", {', '.join(labels)}" if len(over) > 1 else ""
            notes.append(f"95% intervals{where}: over {levels}")
        return Table(titles, lines, notes).format(format)

    def plot(self) -> Figure:
        """Totals of the flights that finish, and E2E's lead by lap and by drone.

        The leads have 95% intervals. They are of the first four worlds.
        """
        rows = [row for world in self.worlds.values() for row in world.rows]
        figure = new_figure(13.0, max(4.2, 1.2 + 0.3 * len(rows)))
        panels = figure.subplots(1, 3)
        for axes, label in zip(panels, PANELS, strict=True):
            tidy(axes)
            axes.set_xlabel(label, color=INK)
        _draw_totals(panels[0], rows)
        shown = dict(list(self.worlds.items())[: len(SERIES)])
        _draw(panels[1], {label: x.leads.laps for label, x in shown.items()})
        drones = {label: x.leads.drones for label, x in shown.items()}
        most = max(map(len, drones.values()))  # the simulator has one
        _draw(panels[2], {label: x if len(x) == most else () for label, x in drones.items()})
        panels[1].set_ylabel(f"{self.title} (s)", color=INK)
        return figure

    def to_json(self) -> dict[str, Any]:
        """Flights and scores of both and the lead, by world, and the provenance."""
        worlds = {}
        for label, (rows, laps, failed_after, x) in self.worlds.items():
            sides = zip(self.names, rows, laps, x.scores, strict=True)
            worlds[label] = {
                name: {"trainings": times.shape[1], "score": score, "at_limit": row.at_limit}
                | row.laps.to_json()
                for name, row, times, score in sides
            } | {"drones": len(laps[0]), "failed_after": failed_after, "lead": vars(x)}
        result = {"worlds": worlds, "provenance": self.provenance}
        return json.loads(json.dumps(result), parse_constant=lambda _: None)  # null for NaN


def _cells(world: World) -> list[str]:
    cells = [
        (number(row.total), f"{row.finished}/{row.runs}", number(score))
        for row, score in zip(world.rows, world.leads.scores, strict=True)
    ]
    return [*cells[0], *cells[1], str(world.leads.total)]


def _draw_totals(axes: Axes, rows: Sequence[Row]) -> None:
    """A box of each row, from the first one down, in the color of its world."""
    for index, row in enumerate(rows):
        style: dict[str, Any] = {"orientation": "horizontal", "widths": 0.6, "sym": "."}
        style |= dict.fromkeys(STYLED, {"color": SERIES[index // 2 % len(SERIES)]})
        axes.boxplot(row.laps.totals[row.done], positions=[index], **style)
    axes.set_yticks(range(len(rows)), [row.policy for row in rows])
    axes.invert_yaxis()


def _draw(axes: Axes, worlds: Mapping[str, Sequence[Interval]]) -> None:
    """Means and intervals of each world, numbered from 1."""
    axes.axhline(0.0, color=MUTED, lw=0.9)
    for index, ((label, intervals), color) in enumerate(zip(worlds.items(), SERIES, strict=False)):
        mean, low, high = np.array(intervals).reshape(-1, 3).T
        places = np.arange(1, len(mean) + 1) + 0.15 * (index - (len(worlds) - 1) / 2)
        axes.vlines(places, low, high, color=color, lw=1.2)
        axes.plot(places, mean, "o", ms=4, color=color, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    head(axes)
