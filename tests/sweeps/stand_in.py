"""A trial whose training is a short sleep; as a command: ``python -m tests.sweeps.stand_in ..``."""

import os
import sys
import time
from pathlib import Path

from tests.sweeps.support import CLIP, RATE, value_of

SECONDS = float(os.environ.get("STAND_IN_SECONDS", "0.2"))


def measure(sweep, params, index, seed, folder, enough):
    """Resume a counter of ticks in the trial's folder, and stop on request."""
    folder = folder.parent
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "workers", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    ticks = folder / "ticks"
    value = value_of(params[CLIP], params[RATE])
    for tick in range(int(ticks.read_text()) if ticks.exists() else 0, 10):
        time.sleep(SECONDS / 10)
        ticks.write_text(str(tick + 1))
        if enough((tick + 1) / 10, value):
            return None
    with open(folder / "finished", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    return value, 1.0


def sweep(path: str, runs: str, *overrides: str) -> int:
    """A whole sweep without its report."""
    from quadjax.core.errors import run_command
    from quadjax.core.folders import claim
    from quadjax.sweeps.run import count, run_sweep
    from quadjax.sweeps.study import open_study
    from quadjax.sweeps.sweep import load_sweep
    from quadjax.sweeps.workers import make_workers

    def run() -> int:
        loaded = load_sweep(path, overrides)
        directory = Path(runs) / loaded.file.name
        with claim(directory, "sweep"):
            workers = make_workers(loaded.file.executor, directory)
            if not run_sweep(loaded, directory, workers, measure):
                return 130
            return int(count(open_study(loaded, directory, run=False)).failed > 0)

    return run_command(run)


if __name__ == "__main__":
    from tests.sweeps import stand_in  # so that workers find ``measure`` by its module

    sys.exit(stand_in.sweep(*sys.argv[1:]))
