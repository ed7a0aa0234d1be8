"""Measuring which layout trains most on this machine: workers pinned to cores, or one vmapped."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.sweeps.machine import Layout, write_calibration
from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.worker import pin
from quadjax.training.progress import bar

SECONDS = 6.0  # of training, each layout
GAIN = 1.1  # lanes are doubled as long as that makes all runs together so much faster
MOST_LANES = 1024


def measure(config: Config, lanes: int, seconds: float) -> float:
    """Training steps a second of ``lanes`` runs of a config in one program, all together."""
    from quadjax.learners import batched_runs as many
    from quadjax.race.build import build_params
    from quadjax.training.build import build_learner
    from quadjax.training.many import start_states

    configs = [dataclasses.replace(config, seed=seed) for seed in range(lanes)]
    learner, params = build_learner(config), [build_params(config)] * lanes
    state = start_states(configs, learner, params)
    hyper = many.stack([learner.hyper] * lanes)
    mesh = many.make_mesh(lanes)
    program, state = many.compile_runs(learner, mesh, 1, hyper, many.stack(params), state)
    state, _ = jax.block_until_ready(program(state))  # touches its memory for the first time
    began, updates = time.monotonic(), 0
    while time.monotonic() - began < seconds or updates < 2:
        state, _ = jax.block_until_ready(program(state))
        updates += 1
    return lanes * updates * learner.steps_per_update / (time.monotonic() - began)


def _measure_apart(sweep: Sweep, cores: list[int | None], lanes: int, gpu: int | None) -> float:
    """The same in a process for each core at once, added up."""
    environment = dict(os.environ)
    if gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = str(gpu)
    path = [str(Path(__file__).resolve().parents[2]), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, path))
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "quadjax.sweeps.calibrate", str(sweep.base)]
            + [json.dumps({"core": core, "lanes": lanes}), *sweep.words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for core in cores
    ]
    total = 0.0
    for process in started:
        output, errors = process.communicate()
        if process.returncode:
            last = (errors.strip().splitlines() or ["no message"])[-1]
            raise InputError(f"measuring {lanes} runs in one program failed: {last}")
        total += float(output.split()[-1])
    return total


def calibrate(sweep: Sweep, directory: Path, layout: Layout) -> Layout:
    """Measure, print and keep the layouts; returns the fastest.

    On a CPU: one worker for each core, one worker alone, and one with twice and four times the
    runs in a program. On a GPU: doubles the runs in a program as long as it pays.

    Raises:
        InputError: a measurement that failed.
    """
    rows: list[dict[str, object]] = []
    gpu = layout.accelerators[0]
    with bar() as progress:
        task = progress.add_task("measuring layouts", total=None if gpu is not None else 4)

        def add(workers: int, lanes: int) -> float:
            cores = list(layout.cores[:workers])
            speed = _measure_apart(sweep, cores, lanes, gpu)
            rows.append({"workers": workers, "lanes": lanes, "runs_steps_per_second": speed})
            progress.advance(task)
            return speed

        if gpu is None:
            for workers, lanes in ((layout.workers, 1), (1, 1), (1, 2), (1, 4)):
                add(workers, lanes)
        else:
            _double(add)
    fastest = write_calibration(directory, rows)
    print(f"{'workers':>8} {'--vmap':>7} {'steps/s, all runs':>18}")
    for row in rows:
        speed = row["runs_steps_per_second"]
        print(f"{row['workers']:>8} {row['lanes']:>7} {speed:>18,.0f}")
    count = fastest["workers"] if gpu is None else layout.workers
    return Layout(
        count,
        int(fastest["lanes"]),
        layout.cores[:count],
        layout.accelerators[:count],
        "measured just now",
    )


def _double(add: object) -> None:
    """Twice the runs, until that does not pay or the memory does not hold them."""
    lanes, before = 1, 0.0
    while lanes <= MOST_LANES:
        try:
            speed = add(1, lanes)
        except InputError:
            if before:
                return
            raise
        if speed < GAIN * before:
            return
        lanes, before = 2 * lanes, speed


def main() -> int:
    """One measurement, for ``calibrate`` alone: CONFIG JSON [key=value ...]."""
    path, text, *words = sys.argv[1:]
    job = json.loads(text)
    pin(job["core"])
    from quadjax.learners.devices import prepare_devices

    prepare_devices("1")
    print(np.round(measure(load_config(path, words), job["lanes"], SECONDS)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
