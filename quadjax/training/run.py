"""A whole training run: from a config to a policy file, its lap table and its figures."""

import dataclasses
import functools
import json
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
from jax.sharding import Mesh

from quadjax.config.schema import Config
from quadjax.core.files import write_json
from quadjax.core.interruptions import interruptions
from quadjax.evaluation.tables import published_total
from quadjax.learners import hosts
from quadjax.learners import sharding as parallel
from quadjax.learners.devices import choose_devices
from quadjax.learners.loop import Hooks, Position, Row, run
from quadjax.learners.networks import ActorCritic
from quadjax.learners.sharding import Chunk
from quadjax.learners.state import Learner, TrainState
from quadjax.policy.file import Policy, read_policy, write_policy
from quadjax.race.build import build_params
from quadjax.race.environment import RaceParams
from quadjax.training.build import build_learner, initial_policy, plan, policy_of, start_state
from quadjax.training.checkpoint import Checkpoints
from quadjax.training.folder import claim_directory, remove_run
from quadjax.training.metrics import MetricsFile, check_tensorboard, rows_of, timed
from quadjax.training.progress import TrainingProgress
from quadjax.training.score import Score


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run came to."""

    directory: Path
    policy: Policy  # the best one
    finished: bool  # all steps were flown; false after an interruption
    summary: dict[str, object]


def train(
    config: Config,
    directory: Path | str,
    resume: bool = False,
    started: float | None = None,
    enough: Callable[[Row], bool] | None = None,
    overwrite: bool = False,
) -> Result:
    """Train a policy and leave everything in ``directory``.

    Writes ``config.yaml``, ``metrics.csv``, ``checkpoints/``, ``policy.npz`` (best by lap time),
    ``policy_last.npz`` and ``summary.json``. Ctrl-C saves and returns early.

    Args:
        config: what to train.
        directory: where to; must hold no run unless it is resumed.
        resume: go on from the last checkpoint, if there is one.
        started: ``time.monotonic()`` from which training time counts; now if not given.
        enough: asked after every chunk with its row of metrics; true ends the run there.
        overwrite: begin anew where there is a run already.

    Raises:
        InputError: a directory with a run in it that is not resumed, a run of another config, or a
            file of the config that cannot be used; all before anything is written or compiled.
        NonFiniteError: training met a number that is not finite.
    """
    started = time.monotonic() if started is None else started
    directory = Path(directory)
    job = _prepare(config)
    if hosts.is_first():
        if overwrite:
            remove_run(directory)
        claim_directory(config, directory, resume)
    if (done := _finished(directory)) is not None:
        return done
    with interruptions() as stop, TrainingProgress(job.steps, config.name) as show:
        watch = _Watch(show, stop, enough)
        position = _run(job, directory, resume, started, watch)
    finished = position.chunks >= job.chunks
    return finish_run(config, directory, position, job.steps_per_chunk, finished, job.mesh.size)


@dataclasses.dataclass(frozen=True)
class _Job:
    """What is trained, settled before anything is written or compiled."""

    config: Config
    params: RaceParams
    learner: Learner
    mesh: Mesh
    updates: int  # of a chunk
    chunks: int  # of the whole run
    initial: Policy | None

    @property
    def steps_per_chunk(self) -> int:
        return self.updates * self.learner.steps_per_update

    @property
    def steps(self) -> int:
        return self.chunks * self.steps_per_chunk


@dataclasses.dataclass(frozen=True)
class _Watch:
    """Who looks on, and what ends a run early."""

    show: TrainingProgress
    stop: threading.Event
    enough: Callable[[Row], bool] | None

    def hooks(
        self, score: Callable[[ActorCritic], float], metrics: MetricsFile, checkpoints: Checkpoints
    ) -> Hooks:
        """What happens between chunks."""
        ended: list[Row] = []

        def report(row: Row) -> None:
            row = timed(row)
            if hosts.is_first():
                metrics.write(row)
                self.show.show(row)
            if self.enough is not None and self.enough(row):
                ended.append(row)

        def stop() -> bool:
            return self.stop.is_set() or bool(ended)

        return Hooks(score, report, checkpoints.save, stop, hosts.agree)


def _prepare(config: Config) -> _Job:
    """Everything that can be refused before a run leaves a trace."""
    params = build_params(config)
    learner = build_learner(config)
    mesh = parallel.make_mesh(choose_devices(config.train.devices, learner.num_shards))
    hosts.meet(mesh)
    updates, chunks = plan(config, learner.steps_per_update)
    initial = initial_policy(config)
    if config.train.tensorboard:
        check_tensorboard()
    return _Job(config, params, learner, mesh, updates, chunks, initial)


def _run(job: _Job, directory: Path, resume: bool, started: float, watch: _Watch) -> Position:
    """Compile, begin or go on, and train; the position where it ended, which is saved."""
    config, params = job.config, job.params
    checkpoints = Checkpoints(directory / "checkpoints")
    score = Score(config, params)
    begin = functools.partial(start_state, config, job.learner, params, job.initial)
    chunk, first = _compile(job.learner, params, job.mesh, job.updates, score, begin)
    position = Position(state=first, best=jax.device_get(first.flown))
    if resume and checkpoints.any:
        position = checkpoints.restore(position)
        position.state = parallel.place(position.state, job.mesh)
        started = time.monotonic() - position.seconds
    done = position.chunks * job.steps_per_chunk
    metrics = MetricsFile(directory, done, config.train.tensorboard)
    position = run(
        chunk,
        params,
        position,
        watch.hooks(score, metrics, checkpoints),
        job.chunks,
        job.steps_per_chunk,
        config.train.checkpoint_seconds,
        started,
    )
    checkpoints.close()
    metrics.close()
    return position


def _compile(
    learner: Learner,
    params: RaceParams,
    mesh: Mesh,
    updates: int,
    score: Score,
    begin: Callable[[], TrainState],
) -> tuple[Chunk, TrainState]:
    """The compiled chunk and the first state, with the score's flight compiled meanwhile."""
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(lambda: parallel.place(begin(), mesh))
        flown = pool.submit(lambda: score(first.result().flown))
        shapes = jax.eval_shape(learner.init, learner.hyper, params, jax.random.key(0))
        chunk = parallel.compile_chunk(
            learner, mesh, updates, params, parallel.abstract(shapes, mesh)
        )
        flown.result()
        return chunk, first.result()


def _finished(directory: Path) -> Result | None:
    """The result of a run that has flown all its steps already; None if it has not."""
    path = directory / "summary.json"
    if jax.process_count() > 1 or not path.exists():
        return None
    summary = json.loads(path.read_text(encoding="utf-8"))
    if not summary["finished"]:
        return None
    return Result(directory, read_policy(directory / "policy.npz"), True, summary)


def finish_run(
    config: Config,
    directory: Path,
    position: Position,
    steps_per_chunk: int,
    finished: bool,
    devices: int,
) -> Result:
    """The policy files and the summary; the first process of several writes them."""
    source = {
        "project": "quadjax",
        "config": config.name,
        "algorithm": config.algorithm,
        "seed": config.seed,
        "steps": position.best_steps or position.chunks * steps_per_chunk,
        "residual": config.vehicle.residual,
    }
    policy = policy_of(config, position.best, source)
    if not hosts.is_first():
        return Result(directory, policy, finished, {})
    path = directory / "metrics.csv"
    rows = rows_of(path) if path.exists() else []
    last_source = source | {"steps": position.chunks * steps_per_chunk}
    write_policy(directory / "policy.npz", policy)
    last = policy_of(config, jax.device_get(position.state.flown), last_source)
    write_policy(directory / "policy_last.npz", last)
    begun = {"name": config.name, "seed": config.seed, "finished": finished}
    counts = {"steps": position.chunks * steps_per_chunk, "devices": devices}
    summary = begun | counts | _measured(config, position, rows)
    write_json(directory / "summary.json", summary)
    return Result(directory, policy, finished, summary)


def _measured(config: Config, position: Position, rows: list[Row]) -> dict[str, object]:
    """What was measured of a run: times in seconds, memory in MiB."""
    last_score = rows[-1]["lap_total"] if rows else math.inf
    return {
        "seconds": round(position.seconds, 1),
        "best_lap_total": _number(position.best_score),
        "best_steps": position.best_steps,
        "last_lap_total": _number(last_score),
        "first_under": _first_under(config, rows),
        "peak_memory_mib": peak_memory_mib(),
    }


def _first_under(config: Config, rows: list[Row]) -> dict[str, float | None] | None:
    """When laps were first faster than the published policy's; None where it flew another race."""
    published = published_total(config)
    if published is None:
        return None
    under = [row for row in rows if row["lap_total"] < published[1]]
    seconds = round(under[0]["seconds"], 1) if under else None
    steps = int(under[0]["steps"]) if under else None
    return {"total": published[1], "seconds": seconds, "steps": steps}


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def peak_memory_mib() -> float | None:
    """Largest resident memory of this process so far, MiB; None where the system cannot say."""
    try:
        import resource
    except ImportError:
        return None
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 0)
