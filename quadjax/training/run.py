"""A whole training run: from a config to a policy file and a folder of results."""

import contextlib
import dataclasses
import gc
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path

import jax
from jax.sharding import Mesh

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.core.interruptions import interruptions
from quadjax.core.mlp import Params
from quadjax.core.precision import single_precision
from quadjax.learners import parallel
from quadjax.learners.loop import ChunkResult, Plan, Row, train_chunks
from quadjax.learners.parallel import Chunk
from quadjax.learners.schedules import Training
from quadjax.learners.state import TrainState
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.training.build import (
    initial_policy,
    make_training,
    start_state,
    trained_policy,
)
from quadjax.training.checkpoint import Checkpoints, RunState
from quadjax.training.folder import FILES, KIND, prepare_folder
from quadjax.training.inputs import (
    check_functions,
    check_learner,
    check_residual,
    without_gradient,
)
from quadjax.training.progress import ProgressBar
from quadjax.training.result import MetricsFile, Run, check_tensorboard, is_finished, write_summary
from quadjax.training.score import FEW_STEPS, gap, make_flights, no_lap
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.summary import summarize

PATIENCE_S = 5.0  # to wait for a compilation after Ctrl-C before the run ends without saving
POLL_S = 0.2
ADVISE_AFTER = 1 / 3  # of a run in which no lap is completed


@single_precision
def train(
    config: Config | Path | str,
    folder: Path | str | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    started: float | None = None,
    stop_when: Callable[[Row], bool] | None = None,
) -> Run:
    """Train a policy and write everything to a folder.

    Writes ``config.yaml`` with copies of the files that it names in ``inputs/``, ``metrics.csv``,
    and at every checkpoint ``checkpoints/``, ``policy.npz`` (the best by ``run.score``),
    ``policy_last.npz`` and ``summary.json``. Ctrl-C saves and returns early.

    Args:
        config: what to train: a config, a preset's name or a YAML file.
        folder: folder of the run; ``runs/NAME`` if not given.
        resume: continue from the last checkpoint, if there is one.
        overwrite: remove what an earlier run left in the folder; other files stay.
        progress: print the progress to stderr.
        started: ``time.monotonic()`` from which training time counts; now if not given.
        stop_when: called after every evaluation with its row of metrics; True ends the run there.

    Raises:
        InputError: a folder that holds a run (and neither ``resume`` nor ``overwrite``), a run of
            another config, or that another process uses; a file of the config that cannot be
            used. Nothing is written or compiled before.
        NonFiniteError: a metric became infinite or NaN.
        KeyboardInterrupt: a second Ctrl-C, or one during a long compilation, when there is
            nothing to save yet.
    """
    if resume and overwrite:
        raise InputError("resume and overwrite exclude each other")
    started = time.monotonic() if started is None else started
    config = config if isinstance(config, Config) else load_config(config)
    folder = Path("runs") / config.name if folder is None else Path(folder)
    if config.run.compilation_cache:
        enable_compilation_cache()
    parallel.prepare_devices(config.run.devices)
    job = _prepare(config)
    with claim(folder, KIND, FILES, overwrite):
        config = prepare_folder(config, folder, resume, overwrite)
        if not (is_finished(folder) and (folder / "policy.npz").exists()):
            job = dataclasses.replace(job, config=config)
            shown = job.plan.steps, config.name, config.evaluate.length
            display = ProgressBar(*shown) if progress else None
            count = getattr(config.learner, "num_envs", None)
            if display is not None and count is not None:
                display.note(f"{config.name}: {count} environments (learner.num_envs)")
            with interruptions() as stop, display or contextlib.nullcontext():
                _run(job, folder, resume, started, display, stop, stop_when)
        return Run.load(folder, config)


@dataclasses.dataclass(frozen=True)
class _Job:
    """The learner, environment and sizes of a run, prepared before anything is written."""

    config: Config
    training: Training
    shapes: TrainState  # of the learner's state
    mesh: Mesh
    plan: Plan
    initial: Policy | None


def _prepare(config: Config) -> _Job:
    """Prepare a run; bad input is rejected here, before anything is written."""
    training, plan = make_training(config)
    check_residual(config, training.task.env_params)
    check_functions(config, training.task.env_params)
    shapes = check_learner(config, training)
    mesh = parallel.choose_mesh(config.run.devices, shapes)
    if config.run.tensorboard:
        check_tensorboard()
    return _Job(config, training, shapes, mesh, plan, initial_policy(config))


def _run(
    job: _Job,
    folder: Path,
    resume: bool,
    started: float,
    display: ProgressBar | None,
    stop: threading.Event,
    stop_when: Callable[[Row], bool] | None,
) -> None:
    """Compile, start or resume, train, and save; ends early after ``stop`` or ``stop_when``."""
    checkpoints, restored = Checkpoints(folder / "checkpoints"), None
    if resume and checkpoints.exists:
        restored = checkpoints.restore(parallel.placed_shapes(job.shapes, job.mesh))
    elif resume and display is not None:
        display.note(f"{folder}: no checkpoint to resume from, starting a new run")
    fly = make_flights(job.config, job.training.task.env_params)
    with _without_garbage_collection():
        state = None if restored is None else restored.state
        chunk, first = _compile(job, fly, state, stop, display)
    run_state = restored or RunState(state=first, best=jax.device_get(first.evaluated))
    if restored is not None:
        started = time.monotonic() - restored.seconds
    metrics = MetricsFile(folder, run_state.steps, job.config.run.tensorboard)
    saved, advise_at = time.monotonic(), max(ADVISE_AFTER * job.plan.steps, FEW_STEPS)
    chunks = train_chunks(chunk, run_state.state, job.plan, run_state.steps)
    while not stop.is_set() and (result := next(chunks, None)) is not None:
        laps = fly(result.state.evaluated)
        run_state = run_state.after(result, laps.score, time.monotonic() - started)
        row = _row(job.config, result, run_state, laps)
        metrics.write(row)
        if display is not None:
            display.show(row)
            if result.steps >= advise_at and not math.isfinite(run_state.best_score):
                advise_at = math.inf
                display.note(no_lap(laps.crashes, result.steps))
        if stop_when is not None and stop_when(row):
            break
        late = time.monotonic() - saved > job.config.run.checkpoint_seconds
        if late and run_state.steps < job.plan.steps:
            _save(job, folder, checkpoints, run_state)
            saved = time.monotonic()
    _save(job, folder, checkpoints, run_state)
    checkpoints.close()
    metrics.close()


def _row(config: Config, result: ChunkResult, run_state: RunState, laps: Laps) -> Row:
    """A row of ``metrics.csv``; a reward is positive there, unlike in the score."""
    name, sign = config.run.score_name, -1.0 if config.run.score == "reward" else 1.0
    return {
        "steps": result.steps,
        "seconds": run_state.seconds,
        "steps_per_second": result.steps_per_second,
        name: sign * laps.score,
        f"best_{name}": sign * run_state.best_score,
        **result.row,
        **gap(config, laps),
        "finished": laps.finished / len(laps.crashes),
    }


def _save(job: _Job, folder: Path, checkpoints: Checkpoints, run_state: RunState) -> None:
    """Write the checkpoint, the best and the last policy, and the summary."""
    steps, last = run_state.steps, jax.device_get(run_state.state.evaluated)
    checkpoints.save(run_state)
    best = trained_policy(job.config, run_state.best, run_state.best_steps or steps)
    best.save(folder / "policy.npz")
    trained_policy(job.config, last, steps).save(folder / "policy_last.npz")
    write_summary(job.config, folder, run_state, job.mesh.size, steps >= job.plan.steps)


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Turn Python's garbage collector off: it visits the many objects of a trace repeatedly.

    This saves 0.7 s of the 19.5 s of CPU time that the compilation of ``e2e`` takes.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _compile(
    job: _Job,
    fly: Callable[[Params], Laps],
    restored: TrainState | None,
    stop: threading.Event,
    display: ProgressBar | None,
) -> tuple[Chunk, TrainState]:
    """The compiled chunk, and the first state: ``restored``, if it is not None.

    The evaluation is compiled at the same time. Compilation and the check of the vehicle, which
    compiles a simulation, run in threads, so that the calling thread receives signals.
    """
    training, mesh = job.training, job.mesh

    def begin() -> TrainState:
        if restored is not None:
            return restored
        return parallel.place(start_state(job.config, training, job.initial), mesh)

    def warn(display: ProgressBar) -> None:
        vehicle = job.config.vehicle
        for text in summarize(base_model(vehicle.model), vehicle.constants).warnings:
            display.note(f"warning: {vehicle.name}: {text}")
        for text in without_gradient(job.config, training.task.env_params):
            display.note(f"warning: {text}")

    pool = ThreadPoolExecutor(4)
    try:
        first = pool.submit(single_precision(begin))
        warm_up = pool.submit(single_precision(lambda: fly(first.result().evaluated)))
        updates = job.plan.updates_per_chunk
        compile_chunk = single_precision(parallel.compile_chunk)
        chunk = pool.submit(compile_chunk, training, mesh, updates, job.shapes)
        warned = [pool.submit(warn, display)] if display is not None else []
        _wait_for((chunk, warm_up, *warned), stop, display)
        return chunk.result(), first.result()
    finally:
        pool.shutdown(wait=False)


def _wait_for(
    futures: Sequence[Future], stop: threading.Event, display: ProgressBar | None
) -> None:
    """Wait until all are done, or one has failed; ``KeyboardInterrupt`` if ``stop`` is set."""
    left = PATIENCE_S
    while True:
        done, running = wait(futures, POLL_S, FIRST_EXCEPTION)
        for future in done:
            future.result()
        if not running:
            return
        if display is not None:
            display.compiling()
        left -= POLL_S * stop.is_set()
        if left < 0:
            raise KeyboardInterrupt
