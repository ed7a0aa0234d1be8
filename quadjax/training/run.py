"""A whole training run: from a config to a policy file and a folder of results."""

import contextlib
import dataclasses
import functools
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

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
from quadjax.learners.loop import Hooks, Position, Row, run
from quadjax.learners.memory import check_memory, tree_bytes
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
from quadjax.training.checkpoint import Checkpoints
from quadjax.training.folder import FILES, KIND, prepare_folder
from quadjax.training.metrics import MetricsFile, check_tensorboard, timed
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
            policy = Policy.load(folder / "policy.npz")
            return Run(config, folder, policy, True, read_summary(folder))
        shown = TrainingProgress(job.steps, config.name) if progress else None
        if shown is not None:
            for note in (*config.notes, *_sizes(config)):
                shown.note(f"{config.name}: {note}")
        with interruptions() as stop, shown or contextlib.nullcontext():
            callbacks = _Callbacks(job, folder, shown, stop, enough)
            position = _run(job, folder, resume, started, callbacks)
        summary = read_summary(folder)
        finished = position.chunks >= job.chunks
        return Run(job.config, folder, job.best(position), finished, summary)


def _sizes(config: Config) -> list[str]:
    """The number of environments of a learner that has one, as a line."""
    count = getattr(config.learner, "num_envs", None)
    return [] if count is None else [f"{count} environments (learner.num_envs)"]


@dataclasses.dataclass(frozen=True)
class _Job:
    """The learner, environment and sizes of a run, prepared before anything is written."""

    config: Config
    params: RaceParams
    learner: Learner
    shapes: TrainState  # of the learner's state
    mesh: Mesh
    updates: int  # of a chunk
    chunks: int  # of the whole run
    initial: Policy | None
    source: dict[str, Any]  # of the policies

    @property
    def steps_per_chunk(self) -> int:
        """Environment steps of one chunk."""
        return self.updates * self.learner.steps_per_update

    @property
    def steps(self) -> int:
        """Environment steps of the whole run."""
        return self.chunks * self.steps_per_chunk

    def policy(self, params: ActorCritic, steps: int) -> Policy:
        """Parameters as a policy file's content.

        Args:
            params: of the networks.
            steps: environment steps after which they were reached.
        """
        return policy_of(self.config, params, {**self.source, "steps": steps})

    def best(self, position: Position) -> Policy:
        """The best policy so far, or the latest before any completes its laps."""
        steps = position.best_steps or position.chunks * self.steps_per_chunk
        return self.policy(position.best, steps)

    def write(self, folder: Path, position: Position) -> None:
        """Write the best and the last policy, and the summary."""
        self.best(position).save(folder / "policy.npz")
        steps = position.chunks * self.steps_per_chunk
        last = self.policy(jax.device_get(position.state.evaluated), steps)
        last.save(folder / "policy_last.npz")
        counts = {"steps": steps, "devices": self.mesh.size}
        write_summary(self.config, folder, position, counts, position.chunks >= self.chunks)


@dataclasses.dataclass(frozen=True)
class _Callbacks:
    """The functions that a run calls between its chunks."""

    job: _Job
    folder: Path
    shown: TrainingProgress | None
    stop: threading.Event
    enough: Callable[[Row], bool] | None

    def hooks(self, score: Score, metrics: MetricsFile, checkpoints: Checkpoints) -> Hooks:
        """The functions that the training loop calls between chunks."""
        ended: list[Row] = []
        advised: list[Row] = []

        def report(row: Row) -> None:
            row = timed(row) | score.metrics
            metrics.write(row)
            if self.shown is not None:
                self.shown.show(row)
                late = row["steps"] >= max(ADVISE_AFTER * self.job.steps, FEW_STEPS)
                if late and not advised and not math.isfinite(row["best_lap_total"]):
                    self.shown.note(no_lap(score.crashes, row["steps"]))
                    advised.append(row)
            if self.enough is not None and self.enough(row):
                ended.append(row)

        def save(position: Position) -> None:
            checkpoints.save(position)
            self.job.write(self.folder, position)

        def stop() -> bool:
            return self.stop.is_set() or bool(ended)

        return Hooks(score, report, save, stop)


def _prepare(config: Config) -> _Job:
    """Prepare a run; bad input is rejected here, before anything is written."""
    params = training_params(config)
    check_functions(choices_of(config), params, len(config.observation.extra))
    learner = build_learner(config)
    shapes = check_learner(config, learner, params)
    mesh = parallel.make_mesh(choose_devices(config.run.devices, learner.num_shards))
    check_memory(tree_bytes(shapes) / mesh.size, mesh)
    updates, chunks = plan(config, learner.steps_per_update)
    initial = initial_policy(config)
    if config.run.tensorboard:
        check_tensorboard()
    source = {
        "project": "quadjax",
        "config": config.name,
        "algorithm": config.learner.algorithm,
        "seed": config.seed,
        "residual": config.vehicle.residual,
    }
    return _Job(config, params, learner, shapes, mesh, updates, chunks, initial, source)


def _run(job: _Job, folder: Path, resume: bool, started: float, callbacks: _Callbacks) -> Position:
    """Compile, start or resume, and train; returns the final position, which is saved."""
    config, params = job.config, job.params
    checkpoints = Checkpoints(folder / "checkpoints")
    score = Score(config, params)
    begin = functools.partial(start_state, config, job.learner, params, job.initial)
    chunk, first = _compile(job, score, begin, callbacks.stop)
    position = Position(state=first, best=jax.device_get(first.evaluated))
    if resume and checkpoints.any:
        position = checkpoints.restore(position)
        position.state = parallel.place(position.state, job.mesh)
        started = time.monotonic() - position.seconds
    done = position.chunks * job.steps_per_chunk
    metrics = MetricsFile(folder, done, config.run.tensorboard)
    position = run(
        chunk,
        params,
        position,
        callbacks.hooks(score, metrics, checkpoints),
        job.chunks,
        job.steps_per_chunk,
        config.run.checkpoint_seconds,
        started,
    )
    checkpoints.close()
    metrics.close()
    return position


def _compile(
    job: _Job, score: Score, begin: Callable[[], TrainState], stop: threading.Event
) -> tuple[Chunk, TrainState]:
    """The compiled chunk and the first state; the evaluation is compiled at the same time.

    Compilation runs in threads, so that this one receives signals.

    Raises:
        KeyboardInterrupt: interrupted, and not compiled ``PATIENCE`` s later.
    """
    learner, params, mesh = job.learner, job.params, job.mesh
    pool = ThreadPoolExecutor(3)
    try:
        first = pool.submit(lambda: parallel.place(begin(), mesh))
        warm_up = pool.submit(lambda: score(first.result().evaluated))
        abstract = parallel.abstract(job.shapes, mesh)
        chunk = pool.submit(parallel.compile_chunk, learner, mesh, job.updates, params, abstract)
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
