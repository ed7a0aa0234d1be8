"""Progress on long work: a Rich bar on a terminal, a line now and then in a log."""

import sys
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from quadjax.learners.loop import Row

LOG_SECONDS = 10.0  # between lines where there is no terminal


def bar(counted: bool = False, console: Console | None = None) -> Progress:
    """A plain progress bar for a known number of steps; silent where there is no terminal."""
    count = [MofNCompleteColumn()] if counted else [TaskProgressColumn()]
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        *count,
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console or Console(stderr=True),
    )


class TrainingProgress:
    """Steps per second, reward, crash rate, lap time and time left of a training run."""

    def __init__(self, total_steps: int, description: str) -> None:
        """Show nothing yet."""
        self._total, self._description = total_steps, description
        self._console = Console(stderr=True)
        self._live = self._console.is_terminal
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._logged = 0.0

    def __enter__(self) -> Self:
        """Start showing."""
        if self._live:
            self._bar.start()
            self._task = self._bar.add_task(
                self._description, total=self._total, status="compiling"
            )
        else:
            print(f"{self._description}: compiling", file=sys.stderr, flush=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop showing."""
        if self._live:
            self._bar.stop()

    def show(self, row: Row) -> None:
        """Show one chunk's row."""
        status = describe(row)
        if self._live:
            self._bar.update(self._task, completed=row["steps"], status=status)
            return
        now = time.monotonic()
        if now - self._logged >= LOG_SECONDS or row["steps"] >= self._total:
            self._logged = now
            left = (self._total - row["steps"]) / row["steps_per_second"]
            share = 100.0 * row["steps"] / self._total
            print(
                f"{self._description}: {share:3.0f}%  {row['seconds']:.0f} s  {status}  "
                f"about {max(left, 0.0):.0f} s left",
                file=sys.stderr,
                flush=True,
            )


def describe(row: Row) -> str:
    """One line of a training row."""
    lap = row["lap_total"]
    flown = f"{lap:.2f} s" if lap < float("inf") else "-"
    best = f" (best {row['best_lap_total']:.2f})" if row["best_lap_total"] < float("inf") else ""
    return (
        f"{row['steps'] / 1e6:.1f} M steps  {row['steps_per_second'] / 1e3:.0f} k/s  "
        f"reward {row['reward']:.3f}  crashes {100.0 * row['crash_rate']:.0f}%  "
        f"laps {flown}{best}"
    )
