"""Tables as text, Markdown and LaTeX: laps of policies, conditions, and single flights."""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from quadjax.core import markdown
from quadjax.core.errors import InputError
from quadjax.evaluation.rows import Row, crash_counts, describe_crashes, interval
from quadjax.flights.flight import Flight, fastest

Format = Literal["text", "markdown", "latex"]
WIDTH = 80  # columns of a terminal
WIDEST_LABEL = 40  # columns of the first column as text; longer labels are wrapped
LISTED = 10  # flights of a group that have a line each
LAPS_NOTE = "seconds; means over the runs that finished"
SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells below titles; the first column has the labels of the lines.

    Attributes:
        titles: of the columns.
        rows: cells of each line.
        headings: text above a line, by the index of the line.
        bold: indices of lines that stand out.
        notes: lines below the table.
    """

    titles: Sequence[str]
    rows: Sequence[Sequence[str]]
    headings: Mapping[int, str] = dataclasses.field(default_factory=dict)
    bold: frozenset[int] = frozenset()
    notes: Sequence[str] = ()

    def format(self, kind: Format = "text") -> str:
        """The table as text of at most 80 columns, as Markdown, or as LaTeX for booktabs.

        Raises:
            InputError: another format.
        """
        if kind not in get_args(Format):
            raise InputError(f"format is {kind!r}, allowed: {', '.join(get_args(Format))}")
        return {"text": self._text, "markdown": self._markdown, "latex": self._latex}[kind]()

    def _text(self) -> str:
        """Columns that do not fit continue in another block."""
        widths = [max(map(len, column)) for column in zip(self.titles, *self.rows, strict=True)]
        label, columns, blocks = min(widths[0], WIDEST_LABEL), list(range(1, len(widths))), []
        while columns:
            count, used = 1, label + 1 + widths[columns[0]]
            while count < len(columns) and used + 1 + widths[columns[count]] <= WIDTH:
                used += 1 + widths[columns[count]]
                count += 1
            blocks.append(self._block(columns[:count], label))
            columns = columns[count:]
        return "\n".join([*blocks, *self.notes])

    def _block(self, columns: Sequence[int], label: int) -> str:
        shown = RichTable(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
        shown.add_column(Text(self.titles[0]), width=label)
        for column in columns:
            shown.add_column(Text(self.titles[column]), justify="right", no_wrap=True)
        for index, row in enumerate(self.rows):
            if index in self.headings:
                shown.add_section()
                shown.add_row(Text(self.headings[index]))
            mark = "*" if index in self.bold else ""
            cells = [row[column] for column in columns]
            shown.add_row(Text(row[0]), *(Text(f"{mark}{cell}{mark}") for cell in cells))
        stream = io.StringIO()
        Console(file=stream, width=10 * WIDTH, color_system=None).print(shown)
        return "\n".join(line.rstrip() for line in stream.getvalue().rstrip().splitlines())

    def _markdown(self) -> str:
        rows = []
        for index, row in enumerate(self.rows):
            if index in self.headings:
                rows.append([self.headings[index], *[""] * (len(row) - 1)])
            mark = "**" if index in self.bold else ""
            rows.append([row[0], *(f"{mark}{cell}{mark}" if cell else "" for cell in row[1:])])
        return "\n\n".join([markdown.table([self.titles, *rows]), *self.notes])

    def _latex(self) -> str:
        width = len(self.titles)
        lines = [rf"\begin{{tabular}}{{l{'r' * (width - 1)}}}", r"\toprule", _line(self.titles)]
        for index, row in enumerate(self.rows):
            if index in self.headings:
                head = _escaped(self.headings[index])
                lines += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{{head}}} \\"]
            elif index == 0:
                lines.append(r"\midrule")
            lines.append(_line(row, bold=index in self.bold))
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _line(cells: Sequence[str], bold: bool = False) -> str:
    texts = ["--" if cell == "-" else _escaped(cell) for cell in cells]
    if bold:
        texts[1:] = [rf"\textbf{{{text}}}" for text in texts[1:]]
    return " & ".join(texts) + r" \\"


def _escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return "".join(SPECIAL.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)


def number(value: float, digits: int = 2, unit: str = "") -> str:
    """A number as text; "-" where there is none."""
    return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "-"


def lap_table(rows: Sequence[Row]) -> Table:
    """Mean laps of each row, total, best and finishers; published rows are below the others.

    The notes say how runs ended early.
    """
    ordered = sorted(rows, key=lambda row: row.published)
    count = max(len(row.lap_means) for row in rows)
    gates = next((row.laps.last_gates for row in rows if row.laps.last_gates), 0)
    titles = [f"lap {lap + 1}" for lap in range(count)]
    if gates:
        titles[-1] = counted(gates, "gate")
    lines = []
    for row in ordered:
        laps = [number(time) for time in row.lap_means] + ["-"] * (count - len(row.lap_means))
        done = ["-", "-"] if row.published else [number(row.best), f"{row.finished}/{row.runs}"]
        lines.append([row.label, *laps, number(row.total), *done])
    first = sum(not row.published for row in rows)
    headings = {first: "published"} if first < len(rows) else {}
    notes = [LAPS_NOTE]
    for row in rows:
        notes += [f"{row.label}: {line}" for line in describe_crashes(row.laps).splitlines()]
    return Table(["", *titles, "total", "best", "finished"], lines, headings, notes=notes)


def flights_table(groups: Mapping[str, Sequence[Flight]]) -> Table:
    """Laps and total of each flight by group; the fastest flight of its group stands out.

    A group of many flights has a line for its fastest and for its slowest one. The last line of a
    group is the mean of the flights that finish.
    """
    laps = max(len(f.lap_times) for flights in groups.values() for f in flights)
    rows: list[list[str]] = []
    headings, bold = {}, set()
    for group, flights in groups.items():
        headings[len(rows)] = group
        done = [f for f in flights if np.isfinite(f.total) and len(f.lap_times) == laps]
        best, shown = fastest(flights), list(flights)
        if len(flights) > LISTED:
            shown = [best, max(done, key=lambda f: f.total)] if len(done) > 1 else [best]
        for flight in shown:
            reason = f" ({flight.crash})" if flight.crash else ""
            times = [number(x) for x in flight.lap_times] + ["-"] * (laps - len(flight.lap_times))
            whole = len(flight.lap_times) == laps and np.isfinite(flight.total)
            if flight is best and len(flights) > 1 and whole:
                bold.add(len(rows))
            total = number(flight.total) if whole else "-"
            rows.append([f"  {flight.name}{reason}", *times, total])
        if len(flights) > 1 and done:
            means = np.mean([[*f.lap_times, f.total] for f in done], axis=0)
            label = f"  mean of {len(done)}"
            label += "" if len(done) == len(flights) else f" ({len(done)}/{len(flights)} finished)"
            rows.append([label, *map(number, means)])
    titles = ["", *(f"lap {lap + 1}" for lap in range(laps)), "total"]
    note = "seconds; *fastest flight of its group*"
    return Table(titles, rows, headings, frozenset(bold), [note])


def _crashed(row: Row) -> str:
    share = f"{100 * row.crashed / row.runs:.3g}%"
    if row.without_lap:
        share += f" and {100 * row.without_lap / row.runs:.3g}% without a lap"
    return f"{share} / {number(row.lap, 3, ' s')}"


def _above(row: Row) -> str:
    return "-" if row.speed_limit is None else number(row.seconds_above, 2, " s")


def _ended(row: Row) -> str:
    counts = crash_counts(row.laps)
    return ", ".join(f"{count} {reason}" for reason, count in counts.items()) or "-"


COLUMNS = {  # of a table of conditions, by name: title and cell
    "crashed": ("crashed / median lap", _crashed),
    "finished": ("finished", lambda row: f"{row.finished} of {row.runs}"),
    "total": ("total", lambda row: f"{number(row.total)} ({row.finished})"),
    "plants": ("total, 95% over the plants", lambda row: interval_text(row.plant_totals)),
    "median": ("median", lambda row: number(row.median_total, 2, " s")),
    "lap": ("median lap", lambda row: number(row.median_lap, 3, " s")),
    "between": ("first to last gate", lambda row: number(row.between, 2, " s")),
    "speed": ("highest speed", lambda row: number(row.highest_speed, 1, " m/s")),
    "above": ("above the fitted speed", _above),
    "ended": ("not finished", _ended),
}


def condition_table(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """A line for each row: policy, where there are several, condition, and columns by name."""
    several = len({row.policy for row in rows}) > 1
    titles = [*(["policy"] if several else []), title, *(COLUMNS[name][0] for name in columns)]
    cells = [
        [*([row.policy] if several else []), row.condition, *(COLUMNS[c][1](row) for c in columns)]
        for row in rows
    ]
    return Table(titles, cells)


def policy_table(rows: Sequence[Row], column: str) -> Table:
    """A line for each policy and a column for each condition, with cells of one column.

    A published row is below the last policy of its race, in the column of its condition.
    """
    conditions = list(dict.fromkeys(row.condition for row in rows))
    policies = list(dict.fromkeys(row.policy for row in rows))
    cells = {(row.policy, row.condition): COLUMNS[column][1](row) for row in rows}
    beside = {row.policy: (row.beside, row.condition) for row in rows if row.beside}
    lines = []
    for policy, following in zip(policies, [*policies[1:], ""], strict=True):
        lines.append([policy, *(cells.get((policy, each), "-") for each in conditions)])
        if policy in beside and beside.get(following) != beside[policy]:
            published, place = beside[policy]
            total = [number(published.total) if each == place else "" for each in conditions]
            lines.append([f"published {published.policy}", *total])
    runs = rows[0].runs
    note = f"Seconds for all laps, mean of the flights that finish; in brackets, of {runs} flights."
    return Table(["policy", *conditions], lines, notes=[note] if column == "total" else [])


def flight_title(flight: Flight) -> str:
    """Laps, time and crash of a flight as a short text."""
    title = f"{counted(len(flight.lap_ends), 'lap')} in {flight.time[-1]:.2f} s"
    return f"{title}, then {flight.crash}" if flight.crash else title


def counted(count: int, noun: str) -> str:
    """A number with its noun: 1 lap, 2 laps."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def interval_text(values: np.ndarray, sign: bool = False) -> str:
    """Mean and half the width of the 95% interval of values (n,) as text; see ``interval``."""
    mean, width = interval(values)
    if not np.isfinite(mean):
        return "-"
    text = f"{mean:+.2f}" if sign else f"{mean:.2f}"
    return f"{text} ± {width:.2f}" if np.isfinite(width) else text
