"""Tables as text, Markdown and LaTeX: laps of policies, conditions, and single flights."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from rich import box
from rich.table import Table as RichTable
from rich.text import Text

from quadjax.core import markdown
from quadjax.core.errors import InputError
from quadjax.evaluation.rows import Row, describe_crashes, interval
from quadjax.flights.flight import Flight, fastest

Format = Literal["text", "markdown", "latex"]
WIDEST_LABEL = 40  # columns of the first column as text; longer labels are wrapped
MAX_LISTED_FLIGHTS = 10  # flights of a group that have a line each
BOLD = re.compile(r"^\*(.*)\*$")
SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells below titles; the first column has the labels of the lines."""

    titles: Sequence[str]  # of the columns
    # cells of each line; a line of one cell is a heading. A cell ``*so*`` stands out
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()  # lines below the table

    def format(self, kind: Format = "text") -> str:
        """The table as text, as Markdown, or as LaTeX for booktabs.

        Raises:
            InputError: another format.
        """
        if kind not in get_args(Format):
            raise InputError(f"format is {kind!r}, allowed: {', '.join(get_args(Format))}")
        return {"text": self._text, "markdown": self._markdown, "latex": self._latex}[kind]()

    def _text(self) -> str:
        grid = RichTable(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
        grid.add_column(Text(self.titles[0]), max_width=WIDEST_LABEL)
        for title in self.titles[1:]:
            grid.add_column(Text(title), justify="right", no_wrap=True)
        for row in self.rows:
            if len(row) == 1:
                grid.add_section()
            grid.add_row(*map(Text, row))
        return "\n".join([*markdown.render_lines(grid), *self.notes])

    def _markdown(self) -> str:
        rows = [[*row, *[""] * (len(self.titles) - len(row))] for row in self.rows]
        bold = [[BOLD.sub(r"**\1**", cell) for cell in row] for row in rows]
        return "\n\n".join([markdown.table([self.titles, *bold]), *self.notes])

    def _latex(self) -> str:
        width = len(self.titles)
        rows = [rf"\begin{{tabular}}{{l{'r' * (width - 1)}}}", r"\toprule", _line(self.titles)]
        if self.rows and len(self.rows[0]) > 1:
            rows.append(r"\midrule")
        for row in self.rows:
            if len(row) == 1:
                head = _escaped(row[0])
                rows += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{{head}}} \\"]
            else:
                rows.append(_line(row))
        return "\n".join([*rows, r"\bottomrule", r"\end{tabular}"])


def _line(cells: Sequence[str]) -> str:
    texts = ["--" if cell == "-" else _escaped(cell) for cell in cells]
    return " & ".join(BOLD.sub(r"\\textbf{\1}", text) for text in texts) + r" \\"


def _escaped(text: str) -> str:
    return "".join(SPECIAL.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)


def number(value: float, digits: int = 2, unit: str = "") -> str:
    """A number as text; "-" where there is none."""
    return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "-"


def counted(count: int, noun: str) -> str:
    """A number with its noun: 1 lap, 2 laps."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def interval_text(values: np.ndarray) -> str:
    """Mean and half the width of the 95% interval of values (n,) as text; see ``interval``."""
    mean, width = interval(values)
    return f"{number(mean)} ± {width:.2f}" if np.isfinite(width) else number(mean)


def lap_table(rows: Sequence[Row]) -> Table:
    """Mean laps of each row, total, best and finishers, then the published row, if it is one.

    A row is named by its condition, and by its policy where there are several. The notes say how
    runs ended early. The gap of the fastest lap to the best known one is shown where that is known.
    """
    published = list(dict.fromkeys(row.published for row in rows if row.published))
    published = published if len(published) == 1 else []
    count = max(len(row.lap_means) for row in [*rows, *published])
    titles = [f"lap {lap + 1}" for lap in range(count)]
    if gates := next((row.laps.last_gates for row in rows if row.laps.last_gates), 0):
        titles[-1] = counted(gates, "gate")
    several = len({row.policy for row in rows}) > 1
    gap = any(row.best_known_lap for row in rows)
    lines, notes = [], ["seconds; means over the runs that finished"]
    if gap:
        notes.append("gap: by how much the fastest lap is slower than the best known one")
    for row in [*rows, *published]:
        names = (row.policy if several or not row.condition else "", row.condition)
        label = ", ".join(filter(None, names))
        done = [number(row.numbers["best"]), f"{row.finished}/{row.runs}"]
        last = ["-", "-"] if row in published and row.runs == 1 else done
        cells = [label, *_laps(row.lap_means, count), number(row.total), *last]
        lines.append([*cells, _gap(row)] if gap else cells)
        notes += [f"{label}: {line}" for line in describe_crashes(row.laps)]
    if published:
        lines.insert(len(rows), ["published"])
    titles = ["", *titles, "total", "best", "finished", *(["gap"] if gap else [])]
    return Table(titles, lines, notes)


def flights_table(groups: Mapping[str, Sequence[Flight]]) -> Table:
    """Laps and total of each flight by group; the fastest flight of its group stands out.

    A group of many flights has a line for its fastest and for its slowest one. The last line of a
    group is the mean of the flights that finish.
    """
    count = max(len(flight.lap_times) for flights in groups.values() for flight in flights)
    rows: list[list[str]] = []
    for group, flights in groups.items():
        rows.append([group])
        done = [f for f in flights if np.isfinite(f.total) and len(f.lap_times) == count]
        best, listed = fastest(flights), flights
        if len(flights) > MAX_LISTED_FLIGHTS:
            listed = [best, max(done, key=lambda f: f.total)] if len(done) > 1 else [best]
        for flight in listed:
            total = flight.total if len(flight.lap_times) == count else math.nan
            cells = [*_laps(flight.lap_times, count), number(total)]
            if flight is best and len(flights) > 1 and np.isfinite(total):
                cells = [f"*{cell}*" for cell in cells]
            reason = f" ({flight.crash})" if flight.crash else ""
            rows.append([f"  {flight.name}{reason}", *cells])
        if len(flights) > 1 and done:
            share = f" ({len(done)}/{len(flights)} finished)" if len(done) < len(flights) else ""
            means = np.mean([[*flight.lap_times, flight.total] for flight in done], axis=0)
            rows.append([f"  mean of {len(done)}{share}", *map(number, means)])
    titles = ["", *(f"lap {lap + 1}" for lap in range(count)), "total"]
    return Table(titles, rows, ["seconds; *fastest flight of its group*"])


def _laps(times: Sequence[float] | np.ndarray, count: int) -> list[str]:
    return [number(time) for time in times] + ["-"] * (count - len(times))


def _gap(row: Row) -> str:
    best = row.best_known_lap
    return "-" if best is None else number(100 * row.laps.gap(best), 1, "%")


def _crashed(row: Row) -> str:
    share = f"{100 * row.crashed / row.runs:.3g}%"
    if row.without_lap:
        share += f" and {100 * row.without_lap / row.runs:.3g}% without a lap"
    return f"{share} / {number(row.numbers['lap'], 3, ' s')}"


def _number(name: str, digits: int, unit: str) -> Callable[[Row], str]:
    return lambda row: number(row.numbers.get(name, math.nan), digits, unit)


COLUMNS: dict[str, tuple[str, Callable[[Row], str]]] = {  # of conditions: title and cell
    "crashed": ("crashed / median lap", _crashed),
    "finished": ("finished", lambda row: f"{row.finished} of {row.runs}"),
    "total": ("total", lambda row: f"{number(row.total)} ({row.finished})"),
    "drones": ("total, 95% over the drones", lambda row: interval_text(row.drone_totals)),
    "median": ("median", _number("time", 2, " s")),
    "lap": ("median lap", _number("median_lap", 3, " s")),
    "between": ("first to last gate", _number("between", 2, " s")),
    "gap": ("gap to the best known lap", _gap),
    "speed": ("highest speed", _number("highest_speed", 1, " m/s")),
    "above": ("above the fitted speed", _number("seconds_above", 2, " s")),
    "ended": (
        "not finished",
        lambda row: ", ".join(f"{count} {reason}" for reason, count in row.ends.items()) or "-",
    ),
}


def condition_table(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """A line for each row: policy, where there are several, condition, and columns by name."""
    several = len({row.policy for row in rows}) > 1
    titles = [*(["policy"] if several else []), title, *(COLUMNS[name][0] for name in columns)]
    lines = [[row.condition, *(COLUMNS[name][1](row) for name in columns)] for row in rows]
    if several:
        lines = [[row.policy, *line] for row, line in zip(rows, lines, strict=True)]
    return Table(titles, lines)


def policy_table(rows: Sequence[Row], column: str) -> Table:
    """A line for each policy and a column for each condition, with cells of one column.

    A published row is below the last policy of its race, in the column of its condition.
    """
    conditions = list(dict.fromkeys(row.condition for row in rows))
    policies = list(dict.fromkeys(row.policy for row in rows))
    cells = {(row.policy, row.condition): COLUMNS[column][1](row) for row in rows}
    published = {row.policy: (row.published, row.condition) for row in rows if row.published}
    lines = []
    for policy, following in zip(policies, [*policies[1:], ""], strict=True):
        lines.append([policy, *(cells.get((policy, label), "-") for label in conditions)])
        if policy in published and published.get(following) != published[policy]:
            row, place = published[policy]
            total = [number(row.total) if label == place else "" for label in conditions]
            lines.append([f"published {row.policy}", *total])
    runs = rows[0].runs
    notes = {
        "total": "Seconds for all laps, mean of the flights that finish; in brackets, of",
        "crashed": "Part of the flights that crash / median of all laps but the first, s; of",
    }
    note = notes.get(column, f"Each cell: {COLUMNS[column][0]}; of")
    return Table(["policy", *conditions], lines, [f"{note} {counted(runs, 'flight')}."])
