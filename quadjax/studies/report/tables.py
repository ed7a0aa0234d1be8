"""Table I: the laps and the total of each flight, the fastest flight of each group in bold."""

from collections.abc import Mapping, Sequence

import numpy as np

from quadjax.flights.flight import Flight, fastest

LISTED = 10  # flights of a group that are shown one by one
Groups = Mapping[str, Sequence[Flight]]
Line = tuple[str, list[float], bool]  # label, laps and total in s, bold


def lines_of(flights: Sequence[Flight], laps: int) -> list[Line]:
    """A line for each flight, or for the fastest and the slowest of many, and the mean of all."""
    done = [f for f in flights if np.isfinite(f.total) and len(f.lap_times) == laps]
    best = fastest(flights)
    shown = list(flights)
    if len(flights) > LISTED:
        shown = [best, max(done, key=lambda f: f.total)] if len(done) > 1 else [best]
    lines = []
    for flight in shown:
        times = [*flight.lap_times[:laps], *[np.nan] * (laps - len(flight.lap_times))]
        total = flight.total if len(flight.lap_times) == laps else np.nan
        reason = f" ({flight.crash})" if flight.crash else ""
        bold = flight is best and len(flights) > 1 and np.isfinite(total)
        lines.append((flight.name + reason, [*times, total], bold))
    if len(flights) > 1 and done:
        means = np.mean([[*f.lap_times, f.total] for f in done], axis=0)
        label = f"mean of {len(done)}"
        label += "" if len(done) == len(flights) else f" ({len(done)}/{len(flights)} finished)"
        lines.append((label, list(means), False))
    return lines


def most_laps(groups: Groups) -> int:
    """The number of laps of the longest flight."""
    return max(len(f.lap_times) for flights in groups.values() for f in flights)


def text_table(groups: Groups) -> str:
    """The table as plain text; the fastest flight of each group is between asterisks."""
    laps = most_laps(groups)
    rows = [["", *(f"lap {lap + 1}" for lap in range(laps)), "total"]]
    for group, flights in groups.items():
        rows.append([group])
        for label, times, bold in lines_of(flights, laps):
            cells = [f"{x:.2f}" if np.isfinite(x) else "-" for x in times]
            rows.append([f"  {label}", *(f"*{cell}*" if bold else cell for cell in cells)])
    widths = [max(len(row[i]) for row in rows if len(row) > max(i, 1)) for i in range(laps + 2)]
    text = []
    for row in rows:
        cells = [f"{cell:>{wide}}" for cell, wide in zip(row[1:], widths[1:], strict=False)]
        text.append("  ".join([f"{row[0]:<{widths[0]}}", *cells]).rstrip())
    text.insert(1, "-" * max(map(len, text)))
    return "\n".join([*text, "seconds; *fastest flight of its group*"])


def latex_table(groups: Groups) -> str:
    """The table as LaTeX, for the package booktabs."""
    laps = most_laps(groups)
    head = " & ".join(["", *(f"lap {lap + 1}" for lap in range(laps)), r"total \\"])
    text = [rf"\begin{{tabular}}{{l{'r' * (laps + 1)}}}", r"\toprule", head]
    for group, flights in groups.items():
        text += [r"\midrule", rf"\multicolumn{{{laps + 2}}}{{l}}{{{_escaped(group)}}} \\"]
        for label, times, bold in lines_of(flights, laps):
            cells = [f"{x:.2f}" if np.isfinite(x) else "--" for x in times]
            cells = [rf"\textbf{{{cell}}}" for cell in cells] if bold else cells
            text.append(" & ".join([rf"\quad {_escaped(label)}", *cells]) + r" \\")
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}"])


def _escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
