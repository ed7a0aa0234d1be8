"""A whole training run: from a config to a policy file, its lap table and its figures."""

import csv
import dataclasses
import math
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import jax
import numpy as np
from jax.sharding import Mesh

from quadjax.checkpoint import Checkpoints
from quadjax.config import to_yaml
from quadjax.devices import choose_devices
from quadjax.errors import InputError
from quadjax.evaluate.laps import SECONDS_PER_LAP, fly_laps
from quadjax.files import write_json, write_text
from quadjax.learn import parallel
from quadjax.learn.loop import Hooks, Position, Row, run
from quadjax.learn.networks import ActorCritic
from quadjax.learn.parallel import Chunk
from quadjax.learn.state import Learner, TrainState
from quadjax.learners import build_learner, flying_of, policy_of, start_state
from quadjax.policies import act_deterministic
from quadjax.policy_file import Policy, write_policy
from quadjax.progress import TrainingProgress
from quadjax.race.build import build_params, choices_of
from quadjax.race.environment import RaceParams
from quadjax.schema import Config

FLYING_TOTAL = 15.70  # s for six laps: what the published E2E policy needs in a faithful simulator


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run came to."""

    directory: Path
    policy: Policy  # the best one
    finished: bool  # all steps were flown; false after an interruption
    summary: dict[str, object]


def train(
    config: Config, directory: Path | str, resume: bool = False, started: float | None = None
) -> Result:
    """Train a policy and leave everything in ``directory``.

    Writes ``config.yaml``, ``metrics.csv``, ``checkpoints/``, ``policy.npz`` (best by lap time),
    ``policy_last.npz`` and ``summary.json``. Ctrl-C saves and returns early.

    Args:
        config: what to train.
        directory: where to; must hold no run unless it is resumed.
        resume: go on from the last checkpoint, if there is one.
        started: ``time.monotonic()`` from which training time counts; now if not given.

    Raises:
        InputError: a directory with a run in it that is not resumed, or a run of another config.
        NonFiniteError: training met a number that is not finite.
    """
    started = time.monotonic() if started is None else started
    directory = Path(directory)
    params = build_params(config)
    learner = build_learner(config)
    count = choose_devices(config.train.devices, learner.lanes)
    mesh = parallel.make_mesh(count)
    updates = max(1, round(config.train.evaluate_every / learner.steps_per_update))
    steps_per_chunk = updates * learner.steps_per_update
    chunks = max(1, round(config.train.steps / steps_per_chunk))
    _claim(config, directory, resume)
    checkpoints = Checkpoints(directory / "checkpoints")
    score = Score(config, params)
    with interruptions() as stop, TrainingProgress(chunks * steps_per_chunk, config.name) as show:
        chunk, first = _compile(config, learner, params, mesh, updates, score)
        position = Position(state=first, best=jax.device_get(first.params))
        if resume and checkpoints.any:
            position = checkpoints.restore(position)
            position.state = parallel.place(position.state, mesh)
            started = time.monotonic() - position.seconds
        done = position.chunks * steps_per_chunk
        metrics = MetricsFile(directory, done, config.train.tensorboard)

        def report(row: Row) -> None:
            metrics.write(row)
            show.show(row)

        hooks = Hooks(score, report, checkpoints.save, stop.is_set)
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
    return _finish(config, directory, position, steps_per_chunk, position.chunks >= chunks, count)


def _compile(
    config: Config,
    learner: Learner,
    params: RaceParams,
    mesh: Mesh,
    updates: int,
    score: "Score",
) -> tuple[Chunk, TrainState]:
    """The compiled chunk and the first state, with the score's flight compiled meanwhile."""

    def initial() -> TrainState:
        return parallel.place(start_state(config, learner, params), mesh)

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(initial)
        flown = pool.submit(lambda: score(first.result().params))
        shapes = jax.eval_shape(learner.init, params, jax.random.key(config.seed))
        chunk = parallel.compile_chunk(
            learner, mesh, updates, params, parallel.abstract(shapes, mesh)
        )
        flown.result()
        return chunk, first.result()


def _claim(config: Config, directory: Path, resume: bool) -> None:
    """Write the config, or see that the one that is there is the same."""
    path = directory / "config.yaml"
    text = to_yaml(config)
    if path.exists() and (directory / "checkpoints" / "latest").exists():
        if not resume:
            raise InputError(
                f"{directory} holds a run already: go on with --resume, begin anew with "
                "--overwrite, or choose another name=NAME"
            )
        old, new = path.read_text(encoding="utf-8").splitlines(), text.splitlines()
        for before, now in zip(old, new, strict=False):
            if before != now:
                raise InputError(
                    f"{path} says '{before.strip()}', the run to resume '{now.strip()}': "
                    "resume with the same config, or choose another name=NAME"
                )
    write_text(path, text)


@contextmanager
def interruptions() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a termination request sets; a second Ctrl-C interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Score:
    """Mean time of all laps, deterministic, from hover; a lap not flown counts eight seconds.

    One flight where every flight is the same; sixteen where disturbances or constants are drawn.
    Infinite where no flight finishes.
    """

    def __init__(self, config: Config, params: RaceParams) -> None:
        """Nothing is flown yet."""
        self._choices, self._params = choices_of(config), params
        self._activation, self._laps = config.network.activation, config.evaluate.laps
        drawn = any(value > 0 for value in config.disturbance.half_widths.values())
        self._runs = 16 if drawn or self._choices.randomise else 1

    def __call__(self, params: ActorCritic) -> float:
        """Fly the policy."""
        local = jax.device_put(params, jax.local_devices()[0])
        laps, _ = fly_laps(
            self._choices,
            self._params,
            act_deterministic,
            flying_of(local, self._activation),
            jax.random.key(0),
            self._laps,
            self._runs,
        )
        if laps.finished == 0:
            return math.inf
        return float(np.nan_to_num(laps.totals, nan=SECONDS_PER_LAP * self._laps).mean())


class MetricsFile:
    """``metrics.csv``: a row per chunk, cut back to the checkpoint when a run is resumed."""

    def __init__(self, directory: Path, steps: int, tensorboard: bool) -> None:
        """Open ``directory/metrics.csv`` after the last row of at most ``steps`` steps."""
        self._path = directory / "metrics.csv"
        self._stream = None
        self._rows = read_metrics(self._path) if steps and self._path.exists() else []
        self._rows = [
            row | {"steps": int(row["steps"])} for row in self._rows if row["steps"] <= steps
        ]
        self._tensorboard = _tensorboard(directory) if tensorboard else None

    def write(self, row: Row) -> None:
        """Add a row."""
        if self._stream is None:
            self._stream = open(self._path, "w", newline="", encoding="utf-8")  # noqa: SIM115
            self._writer = csv.DictWriter(self._stream, list(row))
            self._writer.writeheader()
            self._writer.writerows(self._rows)
        self._writer.writerow(row)
        self._stream.flush()
        if self._tensorboard is not None:
            for name, value in row.items():
                if math.isfinite(value):
                    self._tensorboard.add_scalar(name, value, int(row["steps"]))

    def close(self) -> None:
        """Close the files."""
        if self._stream is not None:
            self._stream.close()
        if self._tensorboard is not None:
            self._tensorboard.close()


def _tensorboard(directory: Path) -> object:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise InputError(
            "train.tensorboard is true, but tensorboardX is not installed: "
            "pip install 'quadjax[tensorboard]'"
        ) from None
    return SummaryWriter(str(directory / "tensorboard"))


def read_metrics(path: Path | str) -> list[Row]:
    """The rows of a ``metrics.csv``."""
    with open(path, newline="", encoding="utf-8") as stream:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]


def _finish(
    config: Config,
    directory: Path,
    position: Position,
    steps_per_chunk: int,
    finished: bool,
    devices: int,
) -> Result:
    """The policy files and the summary."""
    rows = read_metrics(directory / "metrics.csv")
    source = {
        "project": "quadjax",
        "config": config.name,
        "algorithm": config.algorithm,
        "seed": config.seed,
        "steps": position.best_steps or position.chunks * steps_per_chunk,
        "residual": config.vehicle.residual,
    }
    policy = policy_of(config, position.best, source)
    last_source = source | {"steps": position.chunks * steps_per_chunk}
    write_policy(directory / "policy.npz", policy)
    last = policy_of(config, jax.device_get(position.state.params), last_source)
    write_policy(directory / "policy_last.npz", last)
    under = [row for row in rows if row["lap_total"] < FLYING_TOTAL]
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
        "first_under_15.70": (
            {"seconds": round(under[0]["seconds"], 1), "steps": int(under[0]["steps"])}
            if under
            else None
        ),
        "peak_memory_mib": peak_memory_mib(),
    }
    write_json(directory / "summary.json", summary)
    return Result(directory, policy, finished, summary)


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def peak_memory_mib() -> float | None:
    """Largest resident memory of this process so far, MiB; None where the system cannot say."""
    try:
        import resource
    except ImportError:
        return None
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 0)
