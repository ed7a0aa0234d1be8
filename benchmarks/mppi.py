"""Race without training: model predictive path integral control (MPPI) on the simulator.

At every step a number of action sequences is drawn around the last plan and simulated; the plan
becomes their mean with the weights exp(return / temperature) (Williams et al., ICRA 2017). The
planner has the reward of ``e2e_race``, knows the race exactly, and planning takes no time.

    taskset -c 0 python -m benchmarks.mppi --seeds 0 1 2 3 4 [--train]

Totals of three laps from hover, s, of five seeds, and of the mean action of policies of seed 0 (24
million steps). A simulated second takes 0.8 to 1.8 s of one AMD EPYC core:

| track | MPPI | policy |
|---|---|---|
| square4 | 7.22, 7.26, 7.34, 7.15, 7.25 | 6.56 |
| figure8 | 11.48, 11.64, 11.54, 11.45, 11.56 | 10.26 |
| ring8 | 13.77, 15.78, 15.63, 15.36, 15.35 | 10.53 |
"""

import functools
import itertools
import time
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

import quadjax
from quadjax.cli import options, script
from quadjax.core.markdown import table
from quadjax.race import laps
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.types import RaceParams, RaceState

TRACKS = ("square4", "figure8", "ring8")
LAPS, HORIZON = 3, 50  # of a flight; steps
STD, SMOOTH = 0.3, 0.8  # of the noise, and its correlation from step to step
TEMPERATURE = 0.05  # of the weights, in units of the reward


def noise(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Standard normal noise (horizon, samples, actions), correlated from step to step."""

    def blend(last: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
        return (mixed := SMOOTH * last + (1.0 - SMOOTH**2) ** 0.5 * now), mixed

    return jax.lax.scan(blend, (white := jax.random.normal(key, shape))[0], white)[1]


def returns(environment: Race, params: RaceParams, start: RaceState, plan: jax.Array) -> jax.Array:
    """Sum of rewards () of a sequence of actions (horizon, actions) until the drone crashes."""

    def step(carry: tuple[RaceState, jax.Array], action: jax.Array) -> tuple:
        state, alive = carry
        following, value, outcome = environment.transition(params, state, action)
        return (following, alive & ~outcome.crashed), jnp.where(alive, value, 0.0)

    return jax.lax.scan(step, (start, jnp.array(True)), plan)[1].sum()


@functools.partial(jax.jit, static_argnums=(0, 1))
def fly(environment: Race, n: int, params: RaceParams, seed: int, end: int) -> laps.LapState:
    """Fly from hover for at most ``end`` () steps, with ``n`` sequences of actions."""
    exact, key = without_training_limits(environment.model, params), jax.random.key(seed)
    hover = laps.starting_states(environment, exact, key, 1, True)
    first = jax.tree.map(lambda x: x[..., 0], laps.begin(hover, LAPS))

    def step(loop: tuple) -> tuple:
        race, plan, key = loop
        key, use = jax.random.split(key)
        drawn = jnp.clip(plan[:, None] + STD * noise(use, (HORIZON, n, plan.shape[1])), -1.0, 1.0)
        evaluate = functools.partial(returns, environment, params, race.state)
        weights = jax.nn.softmax(jax.vmap(evaluate, in_axes=1)(drawn) / TEMPERATURE)
        plan = jnp.einsum("s,hsa->ha", weights, drawn)
        race = laps.advance(environment, exact, race, plan[0])
        return race, jnp.concatenate([plan[1:], plan[-1:]]), key

    begin = (first, jnp.zeros((HORIZON, environment.model.action_size)), key)
    return jax.lax.while_loop(lambda x: (x[0].state.clock < end) & ~x[0].over, step, begin)[0]


def mppi(
    *,
    tracks: Annotated[tuple[str, ...], options.LIST] = TRACKS,
    seeds: options.Seeds = (0,),
    samples: options.Count = 1024,
    train: bool = False,
) -> None:
    """Print laps and total of MPPI on each track, and those of trained policies."""
    rows: list[tuple[str, ...]] = [("track", "seed", "s a simulated s", "MPPI, s", "policy, s")]
    pairs = list(itertools.product(tracks, seeds))
    configs = [quadjax.load("e2e_race", [f"track={x}", f"seed={seed}"]) for x, seed in pairs]
    for (track, seed), config in zip(pairs, configs, strict=True):
        environment, params = quadjax.make_race(config)
        jax.block_until_ready(fly(environment, samples, params, seed, 1))  # compile
        began, end = time.monotonic(), laps.step_limit(params, LAPS)
        race = jax.block_until_ready(fly(environment, samples, params, seed, end))
        cost = (time.monotonic() - began) / (int(race.state.clock) * config.rules.time_step)
        flown = [np.diff(np.where(race.lap_end > 0.0, race.lap_end, np.nan), prepend=0.0)]
        if train:
            policy = quadjax.train(config, f"runs/mppi/{track}_{seed}", resume=True).policy
            lap = quadjax.evaluate(policy, config, laps=LAPS, runs=1, deterministic=True)
            flown.append(lap.lap_times[0])
        cells = [", ".join(f"{x:.2f}" for x in (*times, times.sum())) for times in flown]
        rows.append((track, f"{seed}", f"{cost:.1f}", *cells, *["-"] * (not train)))
    print(table(rows))


if __name__ == "__main__":
    script(mppi)
