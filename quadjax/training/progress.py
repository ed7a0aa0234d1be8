"""Progress of long operations: a bar on a terminal, a line every ten seconds in a log."""

import math
import sys
import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Column

from quadjax.learners.loop import Row

LOG_EVERY_S = 10.0  # between lines where there is no terminal
MAX_WIDTH = 100  # columns of the training's line
MAX_NAME = 16  # letters of the run's name in it


class ProgressBar:
    """Percentage, time left, steps per second and race times of a training run."""

    def __init__(
        self, total_steps: int, name: str, length: str, console: Console | None = None
    ) -> None:
        """Prepare the line; nothing is shown yet.

        Args:
            total_steps: environment steps of the run.
            name: of the run.
            length: of the flights that are timed, such as "6 laps".
            console: that of stderr if not given.
        """
        self._total, self._name, self._length = total_steps, name, length
        self._console = console or Console(stderr=True)
        self._console.width = min(self._console.width, MAX_WIDTH)
        line = Column(no_wrap=True)
        self._bar = Progress(
            TextColumn("[bold]{task.description}", table_column=line),
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=5)),
            TaskProgressColumn(table_column=line),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True, table_column=line),
            TextColumn("{task.fields[status]}", table_column=line),
            console=self._console,
            expand=True,
        )
        short = name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 1]}…"
        self._task = self._bar.add_task(short, total=total_steps, status="compiling")
        self._began, self._logged = math.inf, -math.inf  # clock times, s

    def __enter__(self) -> Self:
        """Start showing."""
        self._began = time.monotonic()
        if self._console.is_terminal:
            self._bar.start()
        else:
            self.note(f"{self._name}: compiling")
        return self

    def __exit__(self, *_: object) -> None:
        """Stop showing."""
        if self._console.is_terminal:
            self._bar.stop()

    def compiling(self) -> None:
        """Show how long the compilation has taken; call it repeatedly."""
        now = time.monotonic()
        status = f"compiling, {now - self._began:.0f} s"
        if self._console.is_terminal:
            self._bar.update(self._task, status=status)
        elif now - max(self._began, self._logged) >= LOG_EVERY_S:
            self._logged = now
            self.note(f"{self._name}: {status}")

    def show(self, row: Row) -> None:
        """Show one row of metrics."""
        status, now = describe(row, self._length), time.monotonic()
        if self._console.is_terminal:
            self._bar.update(self._task, completed=row["steps"], status=status)
        elif now - self._logged >= LOG_EVERY_S or row["steps"] >= self._total:
            self._logged = now
            left = max((self._total - row["steps"]) / row["steps_per_second"], 0.0)
            done = f"{100.0 * row['steps'] / self._total:3.0f}%"
            self.note(f"{self._name}: {done}  {row['seconds']:.0f} s, {left:.0f} s left  {status}")

    def note(self, text: str) -> None:
        """Print lines above the progress bar."""
        if self._console.is_terminal:
            self._console.print(text, highlight=False, markup=False)
        else:
            print(text, file=sys.stderr, flush=True)


def describe(row: Row, length: str) -> str:
    """A row of metrics in about 40 characters: times of ``length`` once a flight completes it.

    Where not all of the flights finish, it is the score: their mean total time, s, with the time
    limit for a flight that does not finish.
    """
    speed = f"{row['steps_per_second'] / 1e3:.0f} k/s"
    if not math.isfinite(row.get("best_lap_total", math.inf)):
        reward = f"{speed}  reward {row['reward']:.3f}" if "reward" in row else speed
        crashes = f"  crashes {100.0 * row['crash_rate']:.0f}%" if "crash_rate" in row else ""
        return reward + crashes
    total = f"{row['lap_total']:.2f}" if math.isfinite(row["lap_total"]) else "-"
    best = f"best {row['best_lap_total']:.2f}"
    if (finished := row.get("finished", 1.0)) < 1.0:
        return f"{speed}  {100.0 * finished:.0f}% finish, score {total}, {best}"
    return f"{speed}  {length} {total} s, {best}"
