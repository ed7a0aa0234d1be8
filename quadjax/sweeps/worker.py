"""A worker: a process on its own core that takes trials until none waits.

Started by ``quadjax.sweeps.run`` as ``python -m quadjax.sweeps.worker``.
"""

import argparse
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType


def pin(core: int | None) -> None:
    """Keep this process on one core, where the system can."""
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


class Stop:
    """Whether this worker was asked to stop: by a signal, or by its parent's end."""

    def __init__(self, parent: int) -> None:
        """Listen."""
        self._parent, self._asked = parent, False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True

    def orphaned(self) -> bool:
        """Whether whoever started this is gone."""
        return os.getppid() != self._parent

    def __call__(self) -> bool:
        """Whether to stop."""
        return self._asked or self.orphaned()


class Pulse:
    """A thread that says that the worker lives, and ends the training if its parent does."""

    def __init__(self, beat: Callable[[], None], seconds: float, stopped: Stop) -> None:
        """Begin."""
        self._beat, self._seconds, self._stopped = beat, seconds, stopped
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        last = time.monotonic()
        while not self._over.wait(0.5):
            if self._stopped.orphaned():
                os.kill(os.getpid(), signal.SIGTERM)  # a training in progress saves and returns
                return
            if time.monotonic() - last >= self._seconds:
                last = time.monotonic()
                self._beat()

    def stop(self) -> None:
        """End."""
        self._over.set()
        self._thread.join()


def work(
    sweep_file: str, words: Sequence[str], runs: Path, parent: int, lanes: int, deadline: float
) -> None:
    """Run trials until none waits, the time is over or somebody says stop."""
    stopped = Stop(parent)
    from quadjax.sweeps import locks
    from quadjax.sweeps.schema import load_sweep
    from quadjax.sweeps.store import Store

    sweep = load_sweep(sweep_file, words, values=False)  # checked by whoever started this
    directory = runs / sweep.file.name
    _prepare_jax(directory)
    store, me = Store(sweep, directory), locks.this_worker(parent)
    from quadjax.sweeps.together import run_trials
    from quadjax.sweeps.trial import run_trial

    most = max(1, lanes // sweep.file.objective.seeds)
    while not stopped() and time.time() < deadline:
        claims = []
        while len(claims) < most and (claim := store.claim(me)) is not None:
            claims.append(claim)
        if not claims:
            return

        def beat(claims: list = claims) -> None:
            for claim in claims:
                store.beat(claim)

        pulse = Pulse(beat, sweep.file.heartbeat_seconds, stopped)
        try:
            if lanes > 1:
                going_on = run_trials(store, claims, lanes, stopped)
            else:
                going_on = run_trial(store, claims[0], stopped)
        finally:
            pulse.stop()
        if not going_on:
            return


def _prepare_jax(directory: Path) -> None:
    """One device, and compiled programs kept: trials of one shape share them."""
    import jax

    from quadjax.learners.devices import prepare_devices

    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str((directory / "programs").resolve()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    prepare_devices("1")


def main() -> int:
    """The worker's command line, for ``quadjax.sweeps.run`` alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--job", required=True, help="JSON of what to do")
    job = json.loads(parser.parse_args().job)
    pin(job["core"])
    try:
        work(
            job["sweep"],
            job["words"],
            Path(job["runs"]),
            job["parent"],
            job["lanes"],
            job["deadline"],
        )
    except Exception as error:
        traceback.print_exc()
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
