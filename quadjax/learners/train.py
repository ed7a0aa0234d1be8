"""Training on any environment, in memory: without a config, a folder or checkpoints."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError, close_match
from quadjax.core.limits import MAX_SEED, check_integer
from quadjax.core.sections import build
from quadjax.learners.loop import Plan, Row, plan_chunks, train_chunks
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.parallel import choose_mesh, compile_chunk, place
from quadjax.learners.schedules import schedule_learner
from quadjax.learners.section import LearnerSection, Network, Schedule, Schedules
from quadjax.learners.state import Learner

CHUNKS = 20  # of a run, about: how often progress is reported


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """The result of a training run."""

    policy: Callable[[jax.Array], jax.Array]  # observation (..., n) -> mean action (..., k)
    parameters: ActorCritic  # of the policy and the value; averaged, where the learner averages
    metrics: dict[str, np.ndarray]  # (updates,) each
    steps: int  # environment steps done


def train(
    algorithm: LearnerSection,
    environment: Environment,
    params: Any,
    steps: int,
    seed: int = 0,
    network: Network | Networks | None = None,
    schedules: Schedules | None = None,
    progress: Callable[[Row], None] | None = None,
) -> TrainResult:
    """Train a policy on an environment.

    On a CPU, call ``quadjax.learners.parallel.prepare_devices("auto")`` before JAX computes
    anything, so that a run uses all cores.

    Args:
        algorithm: ``PPO(...)``, ``SHAC(...)`` or a learner of the user's.
        environment: three pure functions of one agent.
        params: traced parameters of the environment.
        steps: environment steps of the run, at least; a whole number of updates.
        seed: of all random numbers.
        network: hidden layers of policy and value, or networks with functions of the user's;
            ``normalize``, in units of a race, has no effect.
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
    networks = _networks(algorithm, environment, network)
    learner, plan = _make(algorithm, environment, networks, params, steps, schedules or {})
    state = jax.jit(learner.init)(learner.hyper, params, jax.random.key(seed))
    mesh = choose_mesh("auto", state)
    state = place(state, mesh)
    chunk = compile_chunk(learner, mesh, plan.updates_per_chunk, params, state)
    history: list[dict[str, np.ndarray]] = []
    started = time.monotonic()
    for latest in train_chunks(chunk, params, state, plan):
        state = latest.state
        history.append(latest.metrics)
        if progress is not None:
            progress({"seconds": time.monotonic() - started} | latest.row)
    parameters = jax.device_get(state.evaluated)
    return TrainResult(
        policy=jax.jit(lambda observation: networks.mean(parameters, observation)),
        parameters=parameters,
        metrics={name: np.concatenate([h[name] for h in history]) for name in history[0]},
        steps=plan.steps,
    )


def _networks(
    algorithm: LearnerSection, environment: Environment, network: Network | Networks | None
) -> Networks:
    if not isinstance(network, Network | None):
        return network
    section = network or Network()
    return Networks(
        observation_size=environment.observation_size,
        action_size=environment.action_size,
        hidden=tuple(section.hidden),
        activation=section.activation,
        clip_mean=algorithm.noise_on == "clipped_mean",
    )


def _make(
    algorithm: LearnerSection,
    environment: Environment,
    networks: Networks,
    params: Any,
    steps: int,
    schedules: Schedules,
) -> tuple[Learner, Plan]:
    """The learner with its schedules, and the plan of the run."""
    # Made for one update, to read the steps of an update: the number of updates follows from it.
    steps_per_update = algorithm.make(environment, networks, 1).steps_per_update
    plan = plan_chunks(steps, max(1, steps // CHUNKS), steps_per_update)
    learner = algorithm.make(environment, networks, plan.updates)

    def numbers_at(key: str, value: float | None) -> tuple[Any, Any]:
        name = key.removeprefix("learner.")
        if name in type(algorithm).model_fields:
            changed = algorithm if value is None else algorithm.replace(**{name: value})
            return changed.make(environment, networks, plan.updates).hyper, params
        return learner.hyper, _with_leaf(params, key, value)

    sections = {
        key: value if isinstance(value, Schedule) else build(Schedule, {"linear": [*value]}, key)
        for key, value in schedules.items()
    }
    return schedule_learner(learner, sections, numbers_at, plan, steps), plan


def _with_leaf(params: Any, key: str, value: float | None) -> Any:
    """The environment's parameters with another value of the leaf at a dotted path."""
    leaves = dict(jax.tree_util.tree_leaves_with_path(params))
    paths = {jax.tree_util.keystr(path, simple=True, separator="."): path for path in leaves}
    if key not in paths:
        raise InputError(
            f"schedules: {key} is no hyperparameter and no number of the environment's params"
            f"{close_match(key, list(paths))}"
        )
    if value is not None:
        leaves[paths[key]] = jnp.full_like(leaves[paths[key]], value)
    return jax.tree.unflatten(jax.tree.structure(params), leaves.values())
