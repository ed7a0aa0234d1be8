"""A whole training run: from a config to a policy file, its lap table and its figures."""

import dataclasses
import functools
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import jax
from jax.sharding import Mesh

from quadjax import hosts
from quadjax.checkpoint import Checkpoints
from quadjax.devices import choose_devices
from quadjax.evaluate.tables import published_total
from quadjax.files import write_json
from quadjax.learn import parallel
from quadjax.learn.loop import Hooks, Position, Row, run
from quadjax.learn.parallel import Chunk
from quadjax.learn.state import Learner, TrainState
from quadjax.learners import build_learner, initial_policy, plan, policy_of, start_state
from quadjax.metrics import MetricsFile, check_tensorboard, rows_of, timed
from quadjax.policy_file import Policy, read_policy, write_policy
from quadjax.progress import TrainingProgress
from quadjax.race.build import build_params
from quadjax.race.environment import RaceParams
from quadjax.run_folder import claim_directory, remove_run
from quadjax.schema import Config
from quadjax.score import Score


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
    params = build_params(config)
    learner = build_learner(config)
    count = choose_devices(config.train.devices, learner.lanes)
    mesh = parallel.make_mesh(count)
    hosts.meet(mesh)
    updates, chunks = plan(config, learner.steps_per_update)
    steps_per_chunk = updates * learner.steps_per_update
    initial = initial_policy(config)
    if config.train.tensorboard:
        check_tensorboard()
    if hosts.is_first():
        if overwrite:
            remove_run(directory)
        claim_directory(config, directory, resume)
    if (done := _finished(directory)) is not None:
        return done
    checkpoints = Checkpoints(directory / "checkpoints")
    score = Score(config, params)
    with interruptions() as stop, TrainingProgress(chunks * steps_per_chunk, config.name) as show:
        begin = functools.partial(start_state, config, learner, params, initial)
        chunk, first = _compile(learner, params, mesh, updates, score, begin)
        position = Position(state=first, best=jax.device_get(first.params))
        if resume and checkpoints.any:
            position = checkpoints.restore(position)
            position.state = parallel.place(position.state, mesh)
            started = time.monotonic() - position.seconds
        done = position.chunks * steps_per_chunk
        metrics = MetricsFile(directory, done, config.train.tensorboard)

        def report(row: Row) -> None:
            row = timed(row)
            if hosts.is_first():
                metrics.write(row)
                show.show(row)
            if enough is not None and enough(row):
                ended.append(row)

        ended: list[Row] = []
        hooks = Hooks(
            score, report, checkpoints.save, lambda: stop.is_set() or bool(ended), hosts.agree
        )
        position = run(
            chunk,
            params,
            position,
            hooks,
            chunks,
            steps_per_chunk,
            config.train.checkpoint_seconds,
            started,
        )
    checkpoints.close()
    metrics.close()
    finished = position.chunks >= chunks
    return finish_run(config, directory, position, steps_per_chunk, finished, mesh.size)


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
        flown = pool.submit(lambda: score(first.result().params))
        shapes = jax.eval_shape(learner.init, params, jax.random.key(0))
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


@contextmanager
def interruptions() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a termination request sets; a second Ctrl-C interrupts at once.

    A handler of the caller's own hears of the first one too.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        if callable(before[number]) and before[number] is not signal.default_int_handler:
            before[number](number, frame)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
    last = policy_of(config, jax.device_get(position.state.params), last_source)
    write_policy(directory / "policy_last.npz", last)
    last_score = rows[-1]["lap_total"] if rows else math.inf
    summary = {
        "name": config.name,
        "seed": config.seed,
        "finished": finished,
        "steps": position.chunks * steps_per_chunk,
        "seconds": round(position.seconds, 1),
        "devices": devices,
        "best_lap_total": _number(position.best_score),
        "best_steps": position.best_steps,
        "last_lap_total": _number(last_score),
        "first_under": _first_under(config, rows),
        "peak_memory_mib": peak_memory_mib(),
    }
    write_json(directory / "summary.json", summary)
    return Result(directory, policy, finished, summary)


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
