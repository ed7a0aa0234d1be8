"""Progress of long operations: a bar on a terminal, a line every ten seconds in a log."""

import math
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
from rich.table import Column

from quadjax.learners.loop import Row

LOG_SECONDS = 10.0  # between lines where there is no terminal
MAX_WIDTH = 100  # columns of the training's line
MAX_NAME = 16  # letters of the run's name in it


def bar(counted: bool = False, console: Console | None = None) -> Progress:
    """A progress bar for a known number of steps; silent where there is no terminal."""
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
    """Percentage, time left, steps per second and lap times of a training run."""

    def __init__(self, total_steps: int, name: str, console: Console | None = None) -> None:
        """Prepare the line; nothing is shown yet."""
        self._total, self._name = total_steps, name
        self._console = console or Console(stderr=True)
        self._live = self._console.is_terminal
        self._console.width = min(self._console.width, MAX_WIDTH)
        self._bar = Progress(
            TextColumn("[bold]{task.description}", table_column=Column(no_wrap=True)),
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=5)),
            TaskProgressColumn(table_column=Column(no_wrap=True)),
            TimeRemainingColumn(
                compact=True, elapsed_when_finished=True, table_column=Column(no_wrap=True)
            ),
            TextColumn("{task.fields[status]}", table_column=Column(no_wrap=True)),
            console=self._console,
            expand=True,
        )
        self._logged = -math.inf
        self._advised = False

    def __enter__(self) -> Self:
        """Start showing."""
        if self._live:
            short = self._name if len(self._name) <= MAX_NAME else f"{self._name[: MAX_NAME - 1]}…"
            self._bar.start()
            self._task = self._bar.add_task(short, total=self._total, status="compiling")
        else:
            print(f"{self._name}: compiling", file=sys.stderr, flush=True)
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
        """Show one row of metrics."""
        status = describe(row)
        if self._live:
            self._bar.update(self._task, completed=row["steps"], status=status)
            return
        now = time.monotonic()
        if now - self._logged >= LOG_SECONDS or row["steps"] >= self._total:
            self._logged = now
            left = max((self._total - row["steps"]) / row["steps_per_second"], 0.0)
            done = 100.0 * row["steps"] / self._total
            line = (
                f"{self._name}: {done:3.0f}%  {row['seconds']:.0f} s, {left:.0f} s left  {status}"
            )
            print(line, file=sys.stderr, flush=True)

    def advise(self, text: str) -> None:
        """Print lines of advice, the first time that there are any."""
        if not self._advised:
            self._advised = True
            self.note(text)

    def note(self, text: str) -> None:
        """Print lines above the progress bar."""
        if self._live:
            self._console.print(text, highlight=False, markup=False)
        else:
            print(text, file=sys.stderr, flush=True)


def describe(row: Row) -> str:
    """A row of metrics in at most 40 characters: lap times once all laps are completed."""
    speed = f"{row['steps_per_second'] / 1e3:.0f} k/s"
    if not math.isfinite(row["best_lap_total"]):
        shown = f"{speed}  reward {row['reward']:.3f}" if "reward" in row else speed
        crashes = f"  crashes {100.0 * row['crash_rate']:.0f}%" if "crash_rate" in row else ""
        return shown + crashes
    laps = f"{row['lap_total']:.2f}" if math.isfinite(row["lap_total"]) else "-"
    return f"{speed}  laps {laps} s, best {row['best_lap_total']:.2f} s"
