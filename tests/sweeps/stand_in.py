"""A trial whose training is a short sleep; as a command: ``python -m tests.sweeps.stand_in ..``."""

import os
import sys
import time
from pathlib import Path

from quadjax.sweeps.trial import Job, Outcome
from tests.sweeps.support import value_of

SECONDS = float(os.environ.get("STAND_IN_SECONDS", "0.2"))


def run_trial(job: Job, tell) -> Outcome:
    """Resume a counter of ticks in the trial's folder, and stop on request."""
    job.folder.mkdir(parents=True, exist_ok=True)
    with open(job.folder / "workers", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    ticks = job.folder / "ticks"
    learner = job.configs[0].learner
    value = value_of(learner.clip_range, learner.learning_rate)
    for tick in range(int(ticks.read_text()) if ticks.exists() else 0, 10):
        time.sleep(SECONDS / 10)
        ticks.write_text(str(tick + 1))
        if tell(tick, value):
            return Outcome((), 0.0, False)
    with open(job.folder / "finished", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    return Outcome((value,), 1.0, True)


def sweep(path: str, runs: str, *overrides: str) -> int:
    """A whole sweep without its report."""
    from quadjax.core.errors import run_command
    from quadjax.core.folders import claim
    from quadjax.sweeps.run import make_workers, run_sweep
    from quadjax.sweeps.study import count, open_study
    from quadjax.sweeps.sweep import load_sweep

    def run() -> int:
        loaded = load_sweep(path, overrides)
        directory = Path(runs) / loaded.file.name
        with claim(directory, "sweep"):
            if not run_sweep(loaded, directory, make_workers(loaded, directory, run_trial)):
                return 130
            return int(count(open_study(loaded, directory, run=False)).failed > 0)

    return run_command(run)


if __name__ == "__main__":
    from tests.sweeps import stand_in  # so that workers find ``run_trial`` by its module

    sys.exit(stand_in.sweep(*sys.argv[1:]))
