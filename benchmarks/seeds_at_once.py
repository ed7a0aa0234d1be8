"""Train several seeds of a preset in one program, for a GPU, which one seed does not fill.

Each seed gets the folder that ``quadjax train --seeds`` writes, without a checkpoint; that command
with the same arguments then prints the table of seeds and draws the learning curves. The trainings
end at the first evaluation after ``limit`` seconds. Numbers: docs/design/simulator.md.

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
from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.learners.loop import train_chunks
from quadjax.learners.parallel import repeat
from quadjax.learners.state import ActorCritic
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.race.environment import exact_rules
from quadjax.race.laps import fly_race, laps_of, starting_states, step_limit, time_limit
from quadjax.training import build
from quadjax.training.checkpoint import RunState
from quadjax.training.folder import FILES, KIND, prepare_folder
from quadjax.training.result import MetricsFile, write_summary
from quadjax.training.score import score_runs


def at(tree: Any, seed: int) -> Any:
    """The leaves of a seed."""
    return jax.tree.map(lambda leaf: leaf[seed], tree)


def scorer(config: quadjax.Config) -> Callable[[ActorCritic], list[float]]:
    """The scores of ``quadjax.training.score.make_flights`` for networks (seed, ..)."""
    choices, laps = make_choices(config), config.evaluate.laps
    params = exact_rules(choices.model, build.training_params(config))
    act = act_sampled if config.run.score == "sampled" else act_deterministic
    start_key, key = jax.random.split(jax.random.key(0))
    states = starting_states(choices, params, start_key, score_runs(config), True)
    steps, limit = step_limit(params, laps), time_limit(params.track, laps)

    @jax.jit
    @jax.vmap
    def race(networks: ActorCritic) -> Any:
        policy = build.network_policy(config, networks)
        return fly_race(choices, act, laps, steps, False, params, policy, states, key)[0]

    def score(networks: ActorCritic) -> list[float]:
        flown = jax.device_get(race(networks))
        dt, of_seeds = float(params.rules.time_step), range(len(flown.over))
        return [laps_of(choices, at(flown, i), dt, limit).score for i in of_seeds]

    return score


def seeds_at_once(
    preset: str,
    *changes: str,
    seeds: options.Seeds,
    output: options.Folder = Path("runs"),
    limit: Annotated[float, options.number(0.0, math.inf)] = math.inf,
) -> None:
    """Train the seeds of a preset together."""
    start, name = time.monotonic(), quadjax.load(preset, changes).name
    configs = [quadjax.load(preset, [*changes, f"seed={x}", f"name={name}_seed{x}"]) for x in seeds]
    if configs[0].run.score == "reward":
        raise InputError(f"{preset}: run.score is reward, allowed: mean, sampled")
    folders = [output / config.name for config in configs]
    for config, folder in zip(configs, folders, strict=True):
        with claim(folder, KIND, FILES):
            prepare_folder(config, folder, resume=False, overwrite=False)
    params, (learner, plan) = build.training_params(configs[0]), build.make_learner(configs[0])
    states = [build.start_state(config, learner, params) for config in configs]
    runs = [RunState(state, state.evaluated) for state in states]
    files, score = [MetricsFile(folder, 0, False) for folder in folders], scorer(configs[0])
    updates = repeat(learner.update, plan.updates_per_chunk)
    many = jax.jit(jax.vmap(updates, (None, None, 0)), donate_argnums=2)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    chunks = train_chunks(lambda *x: many(learner.hyper, *x), params, stacked, plan)
    for chunk in chunks:
        seconds, scores = time.monotonic() - start, score(chunk.state.evaluated)
        for i, total in enumerate(scores):
            state, metrics = at(chunk.state, i), at(chunk.metrics, i)
            progress = dataclasses.replace(chunk, state=state, metrics=metrics)
            runs[i] = runs[i].after(progress, total, seconds)
            best = {"lap_total": total, "best_lap_total": runs[i].best_score}
            files[i].write({**progress.row, "seconds": seconds, **best})
        totals = f"{configs[0].evaluate.length} {[round(x, 2) for x in scores]} s"
        print(f"{chunk.steps / 1e6:.1f} M steps, {seconds:.0f} s, {totals}", flush=True)
        if seconds > limit:
            break
    for config, folder, run in zip(configs, folders, runs, strict=True):
        best = build.trained_policy(config, run.best, run.best_steps or run.steps)
        best.save(folder / "policy.npz")
        write_summary(config, folder, run, 1, run.steps >= plan.steps)


if __name__ == "__main__":
    script(seeds_at_once)
