"""Training on any environment, in memory: without a config, a folder or checkpoints."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.limits import MAX_SEED, check_integer
from quadjax.core.sections import Section
from quadjax.learners.devices import choose_devices
from quadjax.learners.loop import Row, check_finite, plan_chunks
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.schedules import make_schedule, with_schedules
from quadjax.learners.section import Network
from quadjax.learners.sharding import compile_chunk, make_mesh, place
from quadjax.learners.state import Learner

CHUNKS = 20  # of a run, at most: how often progress is reported
Schedules = Mapping[str, Sequence[float]]  # name of a hyperparameter -> values, evenly spaced


class MakesLearner(Protocol):
    """What can be trained: ``PPO``, ``SHAC``, or any object with this method."""

    def make(
        self, environment: Environment, networks: Networks, num_updates: int, max_shards: int = 8
    ) -> Learner:
        """The learner on an environment; see ``LearnerSection.make``."""
        ...


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """The result of a training run."""

    policy: Callable[[jax.Array], jax.Array]  # observation (..., n) -> mean action (..., k)
    parameters: ActorCritic  # of the policy and the value; averaged, where the learner averages
    metrics: dict[str, np.ndarray]  # (updates,) each
    steps: int  # environment steps done


def train(
    algorithm: MakesLearner,
    environment: Environment,
    params: Any,
    steps: int,
    seed: int = 0,
    network: Network | None = None,
    schedules: Schedules | None = None,
    progress: Callable[[Row], None] | None = None,
) -> TrainResult:
    """Train a policy on an environment.

    On a CPU, call ``quadjax.learners.devices.prepare_devices("auto")`` before JAX computes
    anything, so that a run uses all cores.

    Args:
        algorithm: ``PPO(...)``, ``SHAC(...)`` or an object with the same ``make``.
        environment: three pure functions of one agent.
        params: traced parameters of the environment.
        steps: environment steps of the run; rounded to whole updates.
        seed: of all random numbers.
        network: hidden layers of policy and value.
        schedules: values of hyperparameters over the run, evenly spaced and linear in between, such
            as ``{"learning_rate": [3e-3, 0.0]}``.
        progress: called with a row of metrics after every chunk of updates.

    Returns:
        The policy, its parameters, and the metrics of every update.

    Raises:
        InputError: a schedule without effect, or a number out of range.
        NonFiniteError: a metric is not finite.
    """
    check_integer("steps", steps, 1, 10**12)
    check_integer("seed", seed, 0, MAX_SEED)
    networks = _networks(algorithm, environment, network or Network())
    learner = _make(algorithm, environment, networks, steps, schedules or {})
    updates, chunks = _plan(steps, learner.steps_per_update)
    mesh = make_mesh(choose_devices("auto", learner.num_shards))
    first = jax.jit(learner.init)(learner.hyper, params, jax.random.key(seed))
    state = place(first, mesh)
    chunk = compile_chunk(learner, mesh, updates, params, state)
    history: list[dict[str, np.ndarray]] = []
    started = time.monotonic()
    for index in range(chunks):
        state, metrics = chunk(params, state)
        history.append({name: np.asarray(value) for name, value in metrics.items()})
        check_finite(history[-1], index * updates)
        if progress is not None:
            done = (index + 1) * updates * learner.steps_per_update
            means = {name: float(value.mean()) for name, value in history[-1].items()}
            progress({"steps": done, "seconds": time.monotonic() - started} | means)
    parameters = jax.device_get(state.evaluated)
    return TrainResult(
        policy=jax.jit(lambda observation: networks.mean(parameters, observation)),
        parameters=parameters,
        metrics={name: np.concatenate([h[name] for h in history]) for name in history[0]},
        steps=chunks * updates * learner.steps_per_update,
    )


def _networks(algorithm: MakesLearner, environment: Environment, network: Network) -> Networks:
    return Networks(
        observation_size=environment.observation_size,
        action_size=environment.action_size,
        hidden=tuple(network.hidden),
        activation=network.activation,
        clip_mean=getattr(algorithm, "noise_on", "mean") == "clipped_mean",
    )


def _plan(steps: int, steps_per_update: int) -> tuple[int, int]:
    return plan_chunks(steps, max(1, steps // CHUNKS), steps_per_update)


def _make(
    algorithm: MakesLearner,
    environment: Environment,
    networks: Networks,
    steps: int,
    schedules: Schedules,
) -> Learner:
    """The learner with its schedules, over the whole run."""

    def make(algorithm: MakesLearner, updates: int) -> Learner:
        return algorithm.make(environment, networks, updates, 8)

    per_update = make(algorithm, 1).steps_per_update
    updates, chunks = _plan(steps, per_update)
    learner = make(algorithm, updates * chunks)
    built = {}
    for name, values in schedules.items():
        if not (isinstance(algorithm, Section) and hasattr(algorithm, name) and len(values) > 1):
            raise InputError(
                f"schedules: {name} is {values}, allowed: two or more values of a hyperparameter"
            )
        trees = [(make(algorithm.replace(**{name: value}), 1).hyper, None) for value in values]
        knots = np.linspace(0.0, updates * chunks * per_update, len(values)).tolist()
        built[name] = make_schedule(name, knots, trees, per_update)
    return with_schedules(learner, built)
