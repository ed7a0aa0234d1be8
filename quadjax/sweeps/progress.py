"""Progress of a sweep: a Rich bar over its trials on a terminal, a line now and then in a log."""

import sys
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.store import Counts

LOG_SECONDS = 60.0  # between lines where there is no terminal and nothing has changed


class SweepProgress:
    """Trials done, the best value so far and the time left."""

    def __init__(self, sweep: Sweep, counts: Counts) -> None:
        """Show nothing yet; the time left is judged by the trials of this session."""
        self._name, self._total, self._before = sweep.file.name, sweep.trials, counts.done
        console = Console(stderr=True)
        self._live = console.is_terminal
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=console,
        )
        self._task = self._bar.add_task(
            self._name, total=self._total, completed=counts.done, status="starting", left=""
        )
        self._began = time.monotonic()
        self._logged = -LOG_SECONDS
        self._shown = -1

    def __enter__(self) -> Self:
        """Start showing."""
        if self._live:
            self._bar.start()
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

    def show(self, counts: Counts) -> None:
        """Show where the trials stand."""
        left = time_left(time.monotonic() - self._began, counts.done - self._before, counts.open)
        status = describe(counts)
        if self._live:
            self._bar.update(self._task, completed=counts.done, status=status, left=left)
            return
        now = time.monotonic()
        if counts.done != self._shown or now - self._logged >= LOG_SECONDS:
            self._logged, self._shown = now, counts.done
            print(
                f"{self._name}: {counts.done}/{self._total} trials  {status}  {left}",
                file=sys.stderr,
                flush=True,
            )


def time_left(seconds: float, done: int, to_do: int) -> str:
    """Time left at the pace so far, in words; unknown before the first trial is done."""
    if done < 1:
        return "time left: unknown yet"
    left = seconds / done * to_do
    minutes, hours = left / 60.0, left / 3600.0
    if hours >= 1.5:
        return f"about {hours:.1f} h left"
    return f"about {minutes:.0f} min left" if minutes >= 1.5 else f"about {left:.0f} s left"


def describe(counts: Counts) -> str:
    """One line of how the trials stand."""
    best = "-" if counts.best is None else f"{counts.best:.2f} s"
    failed = f"  {counts.failed} failed" if counts.failed else ""
    return f"best {best}  {counts.running} running{failed}"
