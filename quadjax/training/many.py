"""Several runs trained at once: as ``quadjax.training.run.train`` does, in one vmapped program.

The runs share every shape and every choice of code; seeds and float hyperparameters differ. There
are no checkpoints: what is interrupted is lost.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.learners import batched_runs as lanes
from quadjax.learners.loop import NonFiniteError, Position, Row, advance, check_finite, row_of
from quadjax.learners.networks import ActorCritic
from quadjax.learners.state import Learner, TrainState
from quadjax.policy.file import write_policy
from quadjax.policy.inference import act_deterministic
from quadjax.race import laps
from quadjax.race.build import build_params, choices_of
from quadjax.race.environment import RaceParams, exact_rules
from quadjax.training.build import (
    build_learner,
    flying_of,
    initial_policy,
    plan,
    policy_of,
    reward_scale,
    with_params,
    with_policy,
)
from quadjax.training.curriculum import curriculum_of
from quadjax.training.folder import prepare_folder
from quadjax.training.metrics import MetricsFile, saved_rows, timed
from quadjax.training.result import Run, write_summary
from quadjax.training.score import score_runs


def shape_of(config: Config) -> tuple:
    """What runs must share to be trained in one program."""
    section = config.ppo if config.algorithm == "ppo" else config.shac
    whole = {k: v for k, v in vars(section).items() if not isinstance(v, float)}
    return (
        config.algorithm,
        choices_of(config),
        tuple(config.network.hidden),
        config.network.activation,
        tuple(sorted(whole.items())),
        (config.train.drones, config.train.steps, config.train.evaluate_every),
        (config.evaluate.laps, score_runs(config), config.episode.dt),
        curriculum_of(config),
        jax.tree.structure(build_learner(config).hyper),
        (config.vehicle.residual, len(config.track.gates)),
    )


@dataclasses.dataclass
class Lane:
    """One of the runs."""

    config: Config
    directory: Path
    params: RaceParams
    metrics: MetricsFile
    position: Position
    error: NonFiniteError | None = None


def start_states(
    configs: Sequence[Config], learner: Learner, params: Sequence[RaceParams]
) -> TrainState:
    """First states of the runs, stacked: those that ``start_state`` gives each by itself."""
    seeds = jnp.stack([jax.random.key(config.seed) for config in configs])
    hyper = lanes.stack([build_learner(config).hyper for config in configs])
    state = jax.jit(jax.vmap(learner.init))(hyper, lanes.stack(params), seeds)
    own = state.params
    if any(config.train.init for config in configs):
        each = [_initial(c, jax.tree.map(lambda x, i=i: x[i], own)) for i, c in enumerate(configs)]
        own = lanes.stack(each)
    return with_params(state, own)


def _initial(config: Config, params: ActorCritic) -> ActorCritic:
    policy = initial_policy(config)
    return params if policy is None else with_policy(params, policy, reward_scale(config))


class Scores:
    """Every run's score, as ``quadjax.training.run.Score`` gives it, in one program."""

    def __init__(self, configs: Sequence[Config], params: Sequence[RaceParams]) -> None:
        """Nothing is flown yet."""
        first = configs[0]
        self._choices = dataclasses.replace(choices_of(first), stagger_clocks=False)
        self._activation, self._laps = first.network.activation, first.evaluate.laps
        exact = [exact_rules(self._choices.model, p) for p in params]
        self._dt = float(exact[0].limits.dt)
        self._params = lanes.stack(exact)
        start_key, self._key = jax.random.split(jax.random.key(0))
        steps = max(laps.step_limit(p, self._laps) for p in exact)
        self._limits = [laps.time_limit(p.track, self._laps) for p in exact]
        runs = score_runs(first)
        starts = [laps.starting_states(self._choices, p, start_key, runs, True) for p in exact]
        self._states = lanes.stack(starts)
        race = functools.partial(
            laps.fly_race, self._choices, act_deterministic, self._laps, steps, False
        )
        self._fly = jax.jit(
            lambda params, policy, states, key: jax.vmap(race, in_axes=(0, 0, 0, None))(
                params, policy, states, key
            )[0]
        )

    def __call__(self, params: ActorCritic) -> list[float]:
        """Fly the stacked policies."""
        flying = flying_of(params, self._activation)
        races = jax.device_get(self._fly(self._params, flying, self._states, self._key))
        count = len(races.over)
        each = [jax.tree.map(lambda x, i=i: x[i], races) for i in range(count)]
        return [
            laps.laps_of(race, self._dt, limit).score
            for race, limit in zip(each, self._limits, strict=True)
        ]


def train_many(
    configs: Sequence[Config],
    directories: Sequence[Path],
    enough: Callable[[list[Row]], bool],
    stopped: Callable[[], bool],
) -> list[Run | NonFiniteError] | None:
    """Train runs of one shape together and leave each in its directory.

    Args:
        configs: of one ``shape_of``.
        directories: one each; what is there is replaced.
        enough: asked after every chunk with every run's row; true ends them all there.
        stopped: whether to give up; nothing is kept then.

    Returns:
        A result for each run, or the error of one that met a number that is not finite; None
        where they were stopped.
    """
    began = time.monotonic()
    params = [build_params(config) for config in configs]
    learners = [build_learner(config) for config in configs]
    first = learners[0]
    updates, chunks = plan(configs[0], first.steps_per_update)
    steps = updates * first.steps_per_update
    state = start_states(configs, first, params)
    hyper = lanes.stack([learner.hyper for learner in learners])
    mesh = lanes.make_mesh(len(configs))
    program, state = lanes.compile_runs(first, mesh, updates, hyper, lanes.stack(params), state)
    scores = Scores(configs, params)
    there = _open(configs, directories, params, state)
    for _ in range(chunks):
        if stopped():
            return None
        chunk_began = time.monotonic()
        state, metrics = program(state)
        values = {name: np.asarray(value) for name, value in metrics.items()}
        took = time.monotonic() - chunk_began
        rows = _advance(there, state, values, scores(state.evaluated), steps, took, began)
        if enough(rows):
            break
    return [_close(lane, steps, chunks, mesh.size) for lane in there]


def _open(
    configs: Sequence[Config],
    directories: Sequence[Path],
    params: Sequence[RaceParams],
    state: TrainState,
) -> list[Lane]:
    host = jax.device_get(state.evaluated)
    opened = []
    for index, (config, directory) in enumerate(zip(configs, directories, strict=True)):
        directory.mkdir(parents=True, exist_ok=True)
        prepare_folder(config, directory, False, False)
        own = jax.tree.map(lambda x, i=index: x[i], host)
        position = Position(state=state.replace(params=own, ema=None), best=own)
        metrics = MetricsFile(directory, 0, config.train.tensorboard)
        opened.append(Lane(config, directory, params[index], metrics, position))
    return opened


def _advance(
    there: Sequence[Lane],
    state: TrainState,
    values: dict[str, np.ndarray],
    scores: Sequence[float],
    steps: int,
    took: float,
    began: float,
) -> list[Row]:
    """Every run one chunk on; one that is not finite any more stays where it was."""
    host = jax.device_get(state.evaluated)
    rows = []
    for index, lane in enumerate(there):
        own = {name: value[:, index] for name, value in values.items()}
        before = lane.position.chunks * len(next(iter(own.values())))
        if lane.error is None:
            try:
                check_finite(own, before)
            except NonFiniteError as error:
                lane.error = error
        score = scores[index] if lane.error is None else math.inf
        flown = jax.tree.map(lambda x, i=index: x[i], host)
        now = state.replace(params=flown, ema=None)
        lane.position = advance(lane.position, now, score, steps, time.monotonic() - began)
        row = timed(row_of(lane.position, own, score, steps, took))
        if lane.error is None:
            lane.metrics.write(row)
        rows.append(row)
    return rows


def _close(lane: Lane, steps: int, chunks: int, devices: int) -> Run | NonFiniteError:
    lane.metrics.close()
    if lane.error is not None:
        return lane.error
    finished = lane.position.chunks >= chunks
    config, folder, position = lane.config, lane.directory, lane.position
    policy = policy_of(config, position.best, {"config": config.name})
    write_policy(folder / "policy.npz", policy)
    counts = {"steps": position.chunks * steps, "devices": devices}
    rows = saved_rows(folder / "metrics.csv")
    summary = write_summary(config, folder, position, rows, counts, finished)
    return Run(config, folder, policy, finished, summary)
