"""Simulate the newest policy of a folder in a thread, whenever it changes."""

import contextlib
import threading
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from quadjax.core.errors import as_options
from quadjax.view.flight import Flight

if TYPE_CHECKING:
    from quadjax.config.schema import Config

RUNS = 8  # sampled flights, for the causes of crashes
SHOWN = 3  # of them, next to the mean action's
LAPS = 2
REST = 4.0  # times the duration of the latest flights, until the next
POLL = 1.0  # s


class Folder(Protocol):
    """A folder that a page shows."""

    kind: str

    @property
    def name(self) -> str:
        """The folder's name."""

    @property
    def policy(self) -> Path:
        """The newest policy's file, which may not exist."""

    @property
    def finished(self) -> bool:
        """Whether the policy is the last one."""

    def state(self) -> dict[str, Any]:
        """Other data of the page."""


class Flyer:
    """Simulates a folder's policy whenever its file changes.

    Attributes:
        record: the latest flights, as a page's data; None before the first.
        causes: number of sampled flights by the reason for which they ended early.
        count: number of simulations so far, which identifies ``record``.
    """

    def __init__(self, folder: Folder, race: "Config | None" = None) -> None:
        """Start the thread; JAX is imported with the first flight.

        Args:
            folder: whose policy flies.
            race: in which it flies; None for that of its file.
        """
        self.record: dict[str, Any] | None = None
        self.causes: dict[str, int] = {}
        self.count = 0
        self.error = ""
        self._folder, self._race, self._stop = folder, race, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> bool:
        """Stop; returns whether the thread has ended: flights under way are not interrupted."""
        self._stop.set()
        self._thread.join(POLL)
        return not self._thread.is_alive()

    def _run(self) -> None:
        seen: tuple[Path, int] | None = None
        while not self._stop.wait(POLL):
            with contextlib.suppress(OSError):
                policy = self._folder.policy
                found = policy, policy.stat().st_mtime_ns
                if found == seen:
                    continue
                started = time.monotonic()
                try:
                    self._fly(policy)
                    self.error = ""
                except OSError:
                    continue
                except Exception as error:  # of the policy file, of JAX, or of the user's functions
                    self.error = as_options(str(error)).partition("\n")[0] or type(error).__name__
                seen = found
                rest = 0.0 if self._folder.finished else REST * (time.monotonic() - started)
                self._stop.wait(min(rest, 60.0))

    def _fly(self, path: Path) -> None:
        """Simulate a policy in its race; the folder's newest one may by now be another."""
        from quadjax.config.race import race_of
        from quadjax.evaluation.recording import recordings
        from quadjax.evaluation.viewing import flight_of
        from quadjax.policy.file import Policy
        from quadjax.policy.pilot import fly_policy
        from quadjax.policy.race import race_of_policy
        from quadjax.view.data import Scene

        policy = Policy.load(path)
        config, _ = race_of_policy(policy, path, self._race)
        choices, params = race_of(config)
        gates, laps = config.track.gates, min(LAPS, config.evaluate.laps)
        flights: list[Flight] = []
        causes: Counter[str] = Counter()
        for name, runs in (("mean action", 1), ("sampled", RUNS)):
            sampled = name == "sampled"
            flown, trace = fly_policy(
                choices, params, policy, laps=laps, runs=runs, deterministic=not sampled, trace=True
            )
            assert trace is not None
            shown = recordings(trace, flown, config.rules.time_step)[:SHOWN]
            flights += [
                flight_of(run, choices.model, gates, f"{name} {k}" if sampled else name)
                for k, run in enumerate(shown, start=1)
            ]
            if sampled:
                causes.update(reason or "finished" for reason in flown.crashes)
        self.record = Scene(self._folder.name, tuple(gates), tuple(flights)).record()
        self.causes = dict(causes)
        self.count += 1
