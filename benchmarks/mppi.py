"""Race without training: model predictive path integral control (MPPI) on the simulator.

At every step a number of action sequences is drawn around the last plan and simulated; the plan
becomes their mean with the weights exp(return / temperature) (Williams et al., ICRA 2017). Returns
are sums of the preset's reward. The planner knows the race exactly and planning takes no time, so
this is an upper bound of what the method does. With ``--train`` a policy of the preset is trained
with each seed, and the table has its mean action from the same hover.

    python -m benchmarks.mppi --seeds 0 1 2 3 4

Five seeds, 1,024 sequences of 50 steps, two shared AMD EPYC cores, of which it uses one; the lap is
the median of laps 2 and 3 of all seeds; best known laps are those of tracks.md and gallery.md:

| track | totals of three laps from hover, s | lap, s | best known, s | s a simulated s |
|---|---|---|---|---|
| square4 | 7.22, 7.26, 7.34, 7.15, 7.25 | 2.28 | 2.039 | 0.8 to 1.8 |
| figure8 | 11.48, 11.64, 11.54, 11.45, 11.56 | 3.85 | 3.239 | 0.8 to 0.9 |
| ring8 | 13.77, 15.78, 15.63, 15.36, 15.35 | 5.11 | 3.31 | 0.9 |
"""

import functools
import itertools
import time
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from cyclopts import Parameter

import quadjax
from quadjax.cli import options as opt
from quadjax.cli import script
from quadjax.config.assembly import race_of
from quadjax.core.markdown import table
from quadjax.race import environment, laps
from quadjax.race.types import Choices, RaceParams, RaceState

STD, SMOOTH = 0.3, 0.8  # of the noise, and its correlation from step to step
TEMPERATURE = 0.05  # of the weights, in units of the reward
TITLES = ("track", "seed", "MPPI, s", "s a simulated s", "policy, s")
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Seeds = Annotated[tuple[int, ...], Parameter(consume_multiple=True)]


def noise(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Standard normal noise (horizon, samples, actions), correlated from step to step."""

    def blend(last: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
        mixed = SMOOTH * last + (1.0 - SMOOTH**2) ** 0.5 * now
        return mixed, mixed

    white = jax.random.normal(key, shape)
    return jax.lax.scan(blend, white[0], white)[1]


def returns(choices: Choices, params: RaceParams, start: RaceState, plan: jax.Array) -> jax.Array:
    """Sum of rewards () of a sequence of actions (horizon, actions) until the drone crashes."""

    def step(carry: tuple[RaceState, jax.Array], action: jax.Array) -> tuple:
        state, alive = carry
        following, value, outcome = environment.transition(choices, params, state, action)
        return (following, alive & ~outcome.crashed), jnp.where(alive, value, 0.0)

    return jax.lax.scan(step, (start, jnp.array(True)), plan)[1].sum()


@functools.partial(jax.jit, static_argnames=("choices", "count", "samples", "horizon"))
def fly(
    choices: Choices,
    count: int,
    samples: int,
    horizon: int,
    params: RaceParams,
    seed: int,
    end: int,
) -> laps.LapState:
    """Fly ``count`` laps from hover, for at most ``end`` () steps."""
    exact, key = environment.exact_rules(choices.model, params), jax.random.key(seed)
    hover = laps.starting_states(choices, exact, key, 1, True)
    first = jax.tree.map(lambda x: x[..., 0], laps.begin(hover, count))

    def step(loop: tuple) -> tuple:
        number, race, plan, key = loop
        key, use = jax.random.split(key)
        shape = horizon, samples, choices.model.action_size
        drawn = jnp.clip(plan[:, None] + STD * noise(use, shape), -1.0, 1.0)
        evaluate = functools.partial(returns, choices, params, race.state)
        weights = jax.nn.softmax(jax.vmap(evaluate, in_axes=1)(drawn) / TEMPERATURE)
        plan = jnp.einsum("s,hsa->ha", weights, drawn)
        race = laps.advance(choices, exact, race, plan[0])
        return number + 1, race, jnp.concatenate([plan[1:], plan[-1:]]), key

    begin = (0, first, jnp.zeros((horizon, choices.model.action_size)), key)
    return jax.lax.while_loop(lambda x: (x[0] < end) & ~x[1].over, step, begin)[1]


def mppi(
    *,
    preset: str = "e2e_race",
    tracks: Names = ("square4", "figure8", "ring8"),
    seeds: Seeds = (0,),
    count: opt.Laps = 3,
    samples: opt.Count = 1024,
    horizon: opt.Count = 50,
    train: bool = False,
    output: Path = Path("runs/mppi"),
) -> None:
    """Print the laps of MPPI on each track, and those of trained policies."""
    rows: list[tuple[str, ...]] = [TITLES]
    for track, seed in itertools.product(tracks, seeds):
        config = quadjax.load(preset, [f"track={track}", f"seed={seed}"])
        choices, params = race_of(config)
        solve = functools.partial(fly, choices, count, samples, horizon, params, seed)
        jax.block_until_ready(solve(1))  # compile
        began = time.monotonic()
        race = jax.block_until_ready(solve(laps.step_limit(params, count)))
        cost = (time.monotonic() - began) / (int(race.state.step) * config.rules.time_step)
        ends = np.asarray(race.lap_end, float)
        flown = [np.diff(np.where(ends > 0.0, ends, np.nan), prepend=0.0)]
        if train:
            policy = quadjax.train(config, output / f"{track}_{seed}", resume=True).policy
            how = {"laps": count, "runs": 1, "deterministic": True}
            flown.append(quadjax.evaluate(policy, config, **how).lap_times[0])
        cells = [", ".join(f"{x:.2f}" for x in (*times, times.sum())) for times in flown]
        rows.append((track, f"{seed}", cells[0], f"{cost:.1f}", *(cells[1:] or ["-"])))
    print(table(rows))
    print("laps from hover, and their total")


if __name__ == "__main__":
    script(mppi)
