"""A worker whose training is a short sleep: python -m tests.sweeps.stand_in --job JSON.

As a sweep: python -m tests.sweeps.stand_in FILE RUNS WORKERS.
"""

import os
import sys
import time
from pathlib import Path

from quadjax.sweeps import run, trial, worker
from tests.sweeps.support import value_of

SECONDS = float(os.environ.get("STAND_IN_SECONDS", "0.3"))


def train_seed(store, config, folder, reports, seed):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "began").write_text(str(os.getpid()))
    time.sleep(SECONDS)
    return value_of({"ppo.clip": config.ppo.clip, "ppo.learning_rate": config.ppo.learning_rate})


def sweep(path: str, runs: str, workers: str) -> int:
    from quadjax.sweeps.machine import Layout
    from quadjax.sweeps.schema import load_sweep
    from quadjax.sweeps.store import Store

    run.WORKER, run.TEND_SECONDS = "tests.sweeps.stand_in", 0.2
    loaded = load_sweep(path)
    store = Store(loaded, Path(runs) / loaded.file.name)
    count = int(workers)
    layout = Layout(count, 1, (None,) * count, (None,) * count, "a test")
    outcome = run.run_sweep(store, path, (), Path(runs), layout)
    return 130 if outcome.interrupted else int(outcome.counts.failed > 0)


if __name__ == "__main__":
    trial.train_seed = train_seed
    sys.exit(worker.main() if sys.argv[1] == "--job" else sweep(*sys.argv[1:]))
