"""A whole training run: from a config to a policy file and a folder of results."""

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path

import jax
from jax.sharding import Mesh

from quadjax.config.loading import load_config
from quadjax.config.race import choices_of
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.core.interruptions import interruptions
from quadjax.learners import sharding as parallel
from quadjax.learners.devices import choose_devices, prepare_devices
from quadjax.learners.loop import Plan, Row, train_chunks
from quadjax.learners.networks import ActorCritic
from quadjax.learners.sharding import Chunk
from quadjax.learners.state import Learner, TrainState
from quadjax.policy.file import Policy
from quadjax.race.environment import RaceParams
from quadjax.training.advice import FEW_STEPS, no_lap
from quadjax.training.build import (
    build_learner,
    initial_policy,
    plan,
    policy_of,
    start_state,
    training_params,
)
from quadjax.training.checkpoint import Checkpoints, Position
from quadjax.training.folder import FILES, KIND, prepare_folder
from quadjax.training.metrics import MetricsFile, check_tensorboard
from quadjax.training.own_functions import check_functions, check_learner
from quadjax.training.progress import TrainingProgress
from quadjax.training.result import Run, is_finished, read_summary, write_summary
from quadjax.training.score import Score

PATIENCE = 5.0  # s to wait for a compilation after Ctrl-C before the run ends without saving
POLL = 0.2  # s
ADVISE_AFTER = 1 / 3  # of a run in which no lap is completed


def train(
    config: Config | Path | str,
    folder: Path | str | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    started: float | None = None,
    enough: Callable[[Row], bool] | None = None,
) -> Run:
    """Train a policy and write everything to a folder.

    Writes ``config.yaml`` with copies of the files that it names in ``inputs/``, ``metrics.csv``,
    and at every checkpoint ``checkpoints/``, ``policy.npz`` (the best by lap time),
    ``policy_last.npz`` and ``summary.json``. Ctrl-C saves and returns early.

    Args:
        config: what to train: a config, a preset's name or a YAML file.
        folder: of the run; ``runs/NAME`` if not given.
        resume: continue from the last checkpoint, if there is one.
        overwrite: remove what an earlier run left in the folder; other files stay.
        progress: print the progress to stderr.
        started: ``time.monotonic()`` from which training time counts; now if not given.
        enough: called after every evaluation with its row of metrics; True ends the run there.

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
    prepare_devices(config.run.devices)
    job = _prepare(config)
    with claim(folder, KIND, FILES, overwrite):
        config = prepare_folder(config, folder, resume, overwrite)
        job = dataclasses.replace(job, config=config)
        if is_finished(folder) and (folder / "policy.npz").exists():
            return Run.load(folder, config)
        display = TrainingProgress(job.plan.steps, config.name) if progress else None
        if display is not None:
            for note in _sizes(config):
                display.note(f"{config.name}: {note}")
        with interruptions() as stop, display or contextlib.nullcontext():
            position = _run(job, folder, resume, started, display, stop, enough)
        finished = position.chunks >= job.plan.chunks
        return Run(config, folder, _best_policy(job, position), finished, read_summary(folder))


def _sizes(config: Config) -> list[str]:
    """The number of environments of a learner that has one, as a line."""
    count = getattr(config.learner, "num_envs", None)
    return [] if count is None else [f"{count} environments (learner.num_envs)"]


@dataclasses.dataclass(frozen=True)
class _Job:
    """The learner, environment and sizes of a run, prepared before anything is written."""

    config: Config
    params: RaceParams
    learner: Learner[RaceParams]
    shapes: TrainState  # of the learner's state
    mesh: Mesh
    plan: Plan
    initial: Policy | None


def _prepare(config: Config) -> _Job:
    """Prepare a run; bad input is rejected here, before anything is written."""
    params = training_params(config)
    check_functions(choices_of(config), params, len(config.observation.extra))
    learner = build_learner(config)
    shapes = check_learner(config, learner, params)
    mesh = parallel.make_mesh(choose_devices(config.run.devices, parallel.env_count(shapes)))
    parallel.check_memory(parallel.tree_bytes(shapes) / mesh.size, mesh)
    if config.run.tensorboard:
        check_tensorboard()
    chunks = plan(config, learner.steps_per_update)
    return _Job(config, params, learner, shapes, mesh, chunks, initial_policy(config))


def _run(
    job: _Job,
    folder: Path,
    resume: bool,
    started: float,
    display: TrainingProgress | None,
    stop: threading.Event,
    enough: Callable[[Row], bool] | None,
) -> Position:
    """Compile, start or resume, train, and save; returns the final position."""
    checkpoints, score = Checkpoints(folder / "checkpoints"), Score(job.config, job.params)
    chunk, first = _compile(job, score, stop)
    position = Position(state=first, best=jax.device_get(first.evaluated))
    if resume and checkpoints.any:
        position = checkpoints.restore(position)
        placed = parallel.place(position.state, job.mesh)
        position = dataclasses.replace(position, state=placed)
        started = time.monotonic() - position.seconds
    done = position.chunks * job.plan.steps_per_chunk
    metrics = MetricsFile(folder, done, job.config.run.tensorboard)

    def report(row: Row) -> bool:
        metrics.write(row)
        if display is not None:
            display.show(row)
            if _needs_advice(row, job.plan.steps):
                display.advise(no_lap(score.crashes, row["steps"]))
        return stop.is_set() or (enough is not None and enough(row))

    def save(position: Position) -> None:
        _save(job, folder, checkpoints, position)

    if not stop.is_set():
        position = _train(job, chunk, position, started, score, report, save)
    save(position)
    checkpoints.close()
    metrics.close()
    return position


def _train(
    job: _Job,
    chunk: Chunk,
    position: Position,
    started: float,
    score: Score,
    report: Callable[[Row], bool],
    save: Callable[[Position], None],
) -> Position:
    """Train until the plan is done or ``report`` returns True; checkpoints in between."""
    saved = time.monotonic()
    for progress in train_chunks(chunk, job.params, position.state, job.plan, position.chunks):
        lap_total = score(progress.state.evaluated)
        position = position.after(progress, lap_total, time.monotonic() - started)
        row = {
            "steps": progress.steps,
            "seconds": position.seconds,
            "steps_per_second": progress.steps_per_second,
            "lap_total": lap_total,
            "best_lap_total": position.best_score,
        }
        if report(row | progress.row | score.metrics):
            break
        due = time.monotonic() - saved > job.config.run.checkpoint_seconds
        if due and position.chunks < job.plan.chunks:
            save(position)
            saved = time.monotonic()
    return position


def _needs_advice(row: Row, steps: int) -> bool:
    """Whether no lap was completed for so long that the config should be changed."""
    late = row["steps"] >= max(ADVISE_AFTER * steps, FEW_STEPS)
    return late and not math.isfinite(row["best_lap_total"])


def _policy(job: _Job, params: ActorCritic, steps: int) -> Policy:
    """Networks after a number of environment steps as a policy file's content."""
    config = job.config
    source = {
        "project": "quadjax",
        "config": config.name,
        "algorithm": config.learner.algorithm,
        "seed": config.seed,
        "residual": config.vehicle.residual,
        "steps": steps,
    }
    return policy_of(config, params, source)


def _best_policy(job: _Job, position: Position) -> Policy:
    """The best policy so far, or the latest before any completes its laps."""
    steps = position.best_steps or position.chunks * job.plan.steps_per_chunk
    return _policy(job, position.best, steps)


def _save(job: _Job, folder: Path, checkpoints: Checkpoints, position: Position) -> None:
    """Write the checkpoint, the best and the last policy, and the summary."""
    checkpoints.save(position)
    _best_policy(job, position).save(folder / "policy.npz")
    steps = position.chunks * job.plan.steps_per_chunk
    _policy(job, jax.device_get(position.state.evaluated), steps).save(folder / "policy_last.npz")
    counts = {"steps": steps, "devices": job.mesh.size}
    write_summary(job.config, folder, position, counts, position.chunks >= job.plan.chunks)


def _compile(job: _Job, score: Score, stop: threading.Event) -> tuple[Chunk, TrainState]:
    """The compiled chunk and the first state; the evaluation is compiled at the same time.

    Compilation runs in threads, so that this one receives signals.

    Raises:
        KeyboardInterrupt: interrupted, and not compiled ``PATIENCE`` s later.
    """
    learner, params, mesh = job.learner, job.params, job.mesh

    def begin() -> TrainState:
        return parallel.place(start_state(job.config, learner, params, job.initial), mesh)

    pool = ThreadPoolExecutor(3)
    try:
        first = pool.submit(begin)
        warm_up = pool.submit(lambda: score(first.result().evaluated))
        abstract = parallel.abstract(job.shapes, mesh)
        updates = job.plan.updates_per_chunk
        chunk = pool.submit(parallel.compile_chunk, learner, mesh, updates, params, abstract)
        _wait_for((chunk, warm_up), stop)
        return chunk.result(), first.result()
    finally:
        pool.shutdown(wait=False)


def _wait_for(futures: Sequence[Future], stop: threading.Event) -> None:
    """Wait until all are done, or one has failed; ``KeyboardInterrupt`` if ``stop`` is set."""
    left = PATIENCE
    while True:
        done, running = wait(futures, POLL, FIRST_EXCEPTION)
        for each in done:
            each.result()
        if not running:
            return
        left -= POLL * stop.is_set()
        if left < 0:
            raise KeyboardInterrupt
