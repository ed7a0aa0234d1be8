"""The columns of the tables: the text of a row in each."""

import statistics
from collections.abc import Callable

from benchmarks.settings import Tree

CONDITIONS = ("mean", "sampled", "mean, random", "sampled, random")  # of flights
BODIES, COUNTS = ("body", "hall"), ("inference", "step", "stack", "start", "flash")


def spread(values: list[float | None] | None) -> str:
    """Median and range of the numbers; the number alone if there is one."""
    numbers = [value for value in values or () if value is not None]
    if not numbers:
        return "-"
    median, low, high = (f"{of(numbers):.2f}" for of in (statistics.median, min, max))
    return median if len(numbers) == 1 else f"{median} ({low}-{high})"


def finished(row: Tree, condition: str) -> str:
    """Number of flights that finish, of those of all seeds."""
    counts = row["finished"].get(condition)
    return f"{sum(counts)}/{row['flights'] * len(counts)}" if counts else "-"


def time(row: Tree, condition: str) -> str:
    """The time of one policy; in brackets, the number of flights that finish."""
    return f"{spread(row['total'][condition])} ({row['finished'][condition][0]})"


COLUMNS: dict[str, Callable[[Tree], str]] = {
    "name": lambda row: f"`{row['name']}`",
    "file": lambda row: f"`{row['policy']}`",
    **{key: lambda row, key=key: f"{row[key]:,}" if row[key] else "-" for key in COUNTS},
    "race": lambda row: f"`{' '.join(row['race'])}`",
    "policy": lambda row: row["label"],
    **{f"{c}, s": lambda row, c=c: spread(row["total"].get(c)) for c in CONDITIONS},
    **{c: lambda row, c=c: time(row, c) for c in CONDITIONS},
    **{body: lambda row, body=body: time(row[body], "sampled") for body in BODIES},
    "hover": lambda row: finished(row, "sampled"),
    "random starts": lambda row: finished(row, "sampled, random"),
    "random starts, body": lambda row: finished(row["body"], "sampled, random"),
    "10^6 steps": lambda row: f"{row['steps'] / 1e6:.1f}",
    "noise": lambda row: f"{statistics.median(row['noise']):.2f}",
    "seed": lambda row: str(row["seeds"][0]),
}


def cell(row: Tree, column: str) -> str:
    """The text of a row in a column."""
    if column in COLUMNS:
        return COLUMNS[column](row)
    if isinstance(value := row[column], list):
        return spread(value)
    return f"{value:.2f}" if isinstance(value, float) else str(value)
