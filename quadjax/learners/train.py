"""Training on any environment, in memory: without a config, a folder or checkpoints."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.limits import MAX_SEED, check_integer
from quadjax.core.sections import Section, build
from quadjax.core.yaml_files import close_match
from quadjax.learners.devices import choose_devices
from quadjax.learners.loop import Plan, Row, plan_chunks, train_chunks
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.schedules import schedule_learner
from quadjax.learners.section import Network, Schedule, Schedules
from quadjax.learners.sharding import compile_chunk, make_mesh, place
from quadjax.learners.state import Learner

CHUNKS = 20  # of a run, at most: how often progress is reported


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
        schedules: numbers that change during training: a ``Schedule``, or only its values, by the
            name of a hyperparameter or the dotted path of a leaf of ``params``, such as
            ``{"learning_rate": [3e-3, 0.0], "reward.gate": Schedule(linear=(0, 10), until=0.5)}``.
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
    learner = _make(algorithm, environment, networks, params, steps, schedules or {})
    plan = _plan(steps, learner.steps_per_update)
    mesh = make_mesh(choose_devices("auto", learner.num_shards))
    first = jax.jit(learner.init)(learner.hyper, params, jax.random.key(seed))
    state = place(first, mesh)
    chunk = compile_chunk(learner, mesh, plan.updates_per_chunk, params, state)
    history: list[dict[str, np.ndarray]] = []
    started = time.monotonic()
    for each in train_chunks(chunk, params, state, plan):
        state = each.state
        history.append(each.metrics)
        if progress is not None:
            progress({"seconds": time.monotonic() - started} | each.row)
    parameters = jax.device_get(state.evaluated)
    return TrainResult(
        policy=jax.jit(lambda observation: networks.mean(parameters, observation)),
        parameters=parameters,
        metrics={name: np.concatenate([h[name] for h in history]) for name in history[0]},
        steps=plan.steps,
    )


def _networks(algorithm: MakesLearner, environment: Environment, network: Network) -> Networks:
    return Networks(
        observation_size=environment.observation_size,
        action_size=environment.action_size,
        hidden=tuple(network.hidden),
        activation=network.activation,
        clip_mean=getattr(algorithm, "noise_on", "mean") == "clipped_mean",
    )


def _plan(steps: int, steps_per_update: int) -> Plan:
    return plan_chunks(steps, max(1, steps // CHUNKS), steps_per_update)


def _make(
    algorithm: MakesLearner,
    environment: Environment,
    networks: Networks,
    params: Any,
    steps: int,
    schedules: Schedules,
) -> Learner:
    """The learner with its schedules, over the whole run."""

    def make(algorithm: MakesLearner, updates: int) -> Learner:
        return algorithm.make(environment, networks, updates, 8)

    def numbers_at(key: str, value: float | None) -> tuple[Any, Any]:
        name = key.removeprefix("learner.")
        if isinstance(algorithm, Section) and name in type(algorithm).model_fields:
            own = algorithm if value is None else algorithm.replace(**{name: value})
            return make(own, 1).hyper, params
        return learner.hyper, _with_leaf(params, key, value)

    per_update = make(algorithm, 1).steps_per_update
    plan = _plan(steps, per_update)
    learner = make(algorithm, plan.updates)
    sections = {
        key: each if isinstance(each, Schedule) else build(Schedule, {"linear": [*each]}, key)
        for key, each in schedules.items()
    }
    return schedule_learner(learner, sections, numbers_at, steps, plan.steps)


def _with_leaf(params: Any, key: str, value: float | None) -> Any:
    """The environment's parameters with another value of the leaf at a dotted path."""
    found, structure = jax.tree_util.tree_flatten_with_path(params)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in found]
    if key not in names:
        raise InputError(
            f"schedules: {key} is no hyperparameter and no number of the environment's params"
            f"{close_match(key, names)}"
        )
    leaves = [leaf for _, leaf in found]
    if value is not None:
        index = names.index(key)
        leaves[index] = jnp.full_like(leaves[index], value)
    return jax.tree.unflatten(structure, leaves)
