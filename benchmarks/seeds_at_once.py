"""Train several seeds of a preset in one program, which a GPU computes about as fast as one seed.

Each seed has a folder as ``quadjax train --seeds`` writes it, without a checkpoint; that command
with the same words then prints the table of seeds and draws the learning curves. After ``limit``
seconds the trainings end where they are.

    python -m benchmarks.seeds_at_once e2e_paper --seeds 0 1 2 --output runs
    quadjax train e2e_paper --seeds 0 1 2 --output runs
"""

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp

import quadjax
from quadjax.cli import options, script
from quadjax.config.assembly import make_choices
from quadjax.core.folders import claim
from quadjax.learners.loop import train_chunks
from quadjax.learners.parallel import repeat
from quadjax.learners.state import ActorCritic
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.race.environment import exact_rules
from quadjax.race.laps import fly_race, laps_of, starting_states, step_limit, time_limit
from quadjax.training.build import (
    make_learner,
    network_policy,
    start_state,
    trained_policy,
    training_params,
)
from quadjax.training.checkpoint import RunState
from quadjax.training.folder import FILES, KIND, prepare_folder
from quadjax.training.result import MetricsFile, write_summary
from quadjax.training.score import score_runs

SAVE_EVERY = 60.0  # s


def scorer(config: quadjax.Config) -> Callable[[ActorCritic], list[float]]:
    """The scores of ``quadjax.training.score.make_flights`` for networks (seed, ..)."""
    choices, laps = make_choices(config), config.evaluate.laps
    params = exact_rules(choices.model, training_params(config))
    act = act_sampled if config.run.score == "sampled" else act_deterministic
    start_key, key = jax.random.split(jax.random.key(0))
    states = starting_states(choices, params, start_key, score_runs(config), True)
    steps, limit = step_limit(params, laps), time_limit(params.track, laps)

    @jax.jit
    @jax.vmap
    def race(networks: ActorCritic) -> Any:
        policy = network_policy(config, networks)
        return fly_race(choices, act, laps, steps, False, params, policy, states, key)[0]

    def score(networks: ActorCritic) -> list[float]:
        flown = jax.device_get(race(networks))
        of_seeds = (jax.tree.map(lambda x, i=i: x[i], flown) for i in range(len(flown.over)))
        dt = float(params.rules.time_step)
        return [laps_of(choices, one, dt, limit).score for one in of_seeds]

    return score


def save(config: quadjax.Config, folder: Path, run: RunState, finished: bool) -> None:
    """Write the best and the last policy of a seed, and its summary."""
    trained_policy(config, run.best, run.best_steps or run.steps).save(folder / "policy.npz")
    last = jax.device_get(run.state.evaluated)
    trained_policy(config, last, run.steps).save(folder / "policy_last.npz")
    write_summary(config, folder, run, 1, finished)


def seeds_at_once(
    preset: str,
    *changes: str,
    seeds: Annotated[tuple[int, ...], options.LIST],
    output: Path = Path("runs"),
    limit: float = math.inf,
) -> None:
    """Train the seeds of a preset together."""
    begun, name = time.monotonic(), quadjax.load(preset, changes).name
    words = [[f"seed={seed}", f"name={name}_seed{seed}"] for seed in seeds]
    configs = [quadjax.load(preset, [*changes, *more]) for more in words]
    folders, params = [output / config.name for config in configs], training_params(configs[0])
    for config, folder in zip(configs, folders, strict=True):
        with claim(folder, KIND, FILES):
            prepare_folder(config, folder, resume=False, overwrite=False)
    (learner, plan), score = make_learner(configs[0]), scorer(configs[0])
    states = [start_state(config, learner, params) for config in configs]
    runs = [RunState(state, state.evaluated) for state in states]
    files = [MetricsFile(folder, 0, False) for folder in folders]
    many = jax.vmap(repeat(learner, plan.updates_per_chunk), (None, None, 0))
    update = jax.jit(many, donate_argnums=2)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    chunks = train_chunks(lambda *x: update(learner.hyper, *x), params, stacked, plan)
    for chunk in chunks:
        seconds, scores = time.monotonic() - begun, score(chunk.state.evaluated)
        for i, total in enumerate(scores):
            one = dataclasses.replace(
                chunk,
                state=jax.tree.map(lambda leaf, i=i: leaf[i], chunk.state),
                metrics={key: value[i] for key, value in chunk.metrics.items()},
            )
            runs[i] = runs[i].after(one, total, seconds)
            best = {"lap_total": total, "best_lap_total": runs[i].best_score}
            files[i].write({**one.row, "seconds": seconds, **best})
        print(
            f"{seconds:.0f} s, {chunk.steps:,} steps of {plan.steps:,}, laps {scores}", flush=True
        )
        if seconds > limit:
            break
    for config, folder, run in zip(configs, folders, runs, strict=True):
        save(config, folder, run, run.steps >= plan.steps)


if __name__ == "__main__":
    script(seeds_at_once)
