"""Trainings whose races have the same shapes, as one program; see ``benchmarks.at_once``."""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import quadjax
from quadjax.core.errors import InputError
from quadjax.core.mlp import Params
from quadjax.learners.loop import Plan, train_chunks
from quadjax.learners.parallel import repeat
from quadjax.learners.schedules import Training
from quadjax.policy.inference import PolicyParams, act_deterministic, act_sampled
from quadjax.race import laps
from quadjax.race.environment import without_training_limits
from quadjax.race.types import RaceParams
from quadjax.training import build
from quadjax.training.checkpoint import RunState
from quadjax.training.result import MetricsFile, write_summary
from quadjax.training.score import score_runs

Configs, Made = Sequence[quadjax.Config], Sequence[tuple[Training, Plan]]


def stack(trees: Sequence[Any]) -> tuple[Any, Any]:
    """Trees as one, and its axes for ``vmap``: None where all have the same leaf.

    Raises:
        InputError: trees of other shapes.
    """
    shapes = [(jax.tree.structure(x), [np.shape(y) for y in jax.tree.leaves(x)]) for x in trees]
    if any(shape != shapes[0] for shape in shapes):
        raise InputError("--each: races of other shapes, allowed: the same keys, as many gates")
    leaves, structure = list(zip(*map(jax.tree.leaves, trees), strict=True)), shapes[0][0]
    axes = [None if all(np.array_equal(row[0], x) for x in row) else 0 for row in leaves]
    rows = [x[0] if axis is None else jnp.stack(x) for axis, x in zip(axes, leaves, strict=True)]
    return jax.tree.unflatten(structure, rows), jax.tree.unflatten(structure, axes)


def scorer(config: quadjax.Config, params: Sequence[RaceParams]) -> Callable[[Any], list[float]]:
    """The scores of ``quadjax.training.score.make_flights`` for the parameters of all trainings."""
    (environment, _), runs = quadjax.make_race(config), score_runs(config)
    act = act_sampled if config.run.score == "sampled" else act_deterministic
    start_key, key = jax.random.split(jax.random.key(0))
    exact = [without_training_limits(environment.model, x) for x in params]
    exact = [x.replace(observation_scale=y.observation_scale) for x, y in zip(exact, params)]
    length, dt = config.evaluate.laps, float(exact[0].rules.time_step)
    sizes = length, max(laps.step_limit(x, length) for x in exact), False
    stacked, axes = stack(exact)
    network = build.make_network(config).clone(privileged_size=0)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(axes, 0))
    def fly(race: RaceParams, params: Params) -> Any:
        policy = PolicyParams({name: params[name] for name in ("actor", "log_std")}, network)
        states = laps.starting_states(environment, race, start_key, runs, from_hover=True)
        return laps.fly_race(environment, act, *sizes, race, policy, states, key)[0]

    def score(params: Params) -> list[float]:
        flown = jax.device_get(fly(stacked, params))
        limits = [laps.time_limit(race.track, length) for race in exact]
        return [laps.laps_of(environment, at(flown, i), dt, x).score for i, x in enumerate(limits)]

    return score


def at(tree: Any, index: int) -> Any:
    """The leaves of one training."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def train(configs: Configs, made: Made, folders: Sequence[Path], limit: float) -> None:
    """Train all configs together, with the trainings and plans ``made``; write their folders."""
    start, first = time.monotonic(), configs[0]
    trainings, (_, plan) = [each for each, _ in made], made[0]
    params = [training.task.env_params for training in trainings]
    # Each by itself: the batched QR of their initial kernels can block for ever on two cores.
    begun = [build.start_state(*each) for each in zip(configs, trainings, strict=True)]
    runs = [RunState(state, jax.device_get(state.evaluated)) for state in begun]
    stacked, axes = stack(trainings)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *begun)
    updates = functools.partial(repeat, count=plan.updates_per_chunk)
    many = jax.jit(jax.vmap(updates, (axes, 0)), donate_argnums=1)
    small = dataclasses.replace(begun[0], env_states=None, optimizer=(), target=None, ema=None)
    files, score = [MetricsFile(folder, 0, False) for folder in folders], scorer(first, params)
    for chunk in train_chunks(functools.partial(many, stacked), states, plan):
        seconds, scores = time.monotonic() - start, score(chunk.state.evaluated)
        latest = jax.device_get(chunk.state.evaluated)
        for i, total in enumerate(scores):
            state = dataclasses.replace(small, params=at(latest, i))
            one = dataclasses.replace(chunk, state=state, metrics=at(chunk.metrics, i))
            runs[i] = runs[i].after(one, total, seconds)
            best = {"lap_total": total, "best_lap_total": runs[i].best_score}
            files[i].write({**one.row, "seconds": seconds, **best})
        totals = f"{first.evaluate.length} {[round(x, 2) for x in scores]} s"
        print(f"{chunk.steps / 1e6:.1f} M steps, {seconds:.0f} s, {totals}", flush=True)
        if seconds > limit:
            break
    for config, folder, run in zip(configs, folders, runs, strict=True):
        best = build.trained_policy(config, run.best, run.best_steps or run.steps)
        best.save(folder / "policy.npz")
        write_summary(config, folder, run, 1, run.steps >= plan.steps)
