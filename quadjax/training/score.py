"""The flights by which a policy is scored during training, and advice where none is complete."""

import dataclasses
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp

from quadjax.config.assembly import make_environment
from quadjax.config.schema import Config
from quadjax.core.mlp import Params
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.race import laps as flights
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.laps import OUT_OF_TIME, Laps, fly_laps
from quadjax.race.rules import TERMINATIONS
from quadjax.race.types import RaceParams
from quadjax.training.build import network_policy

FEW_STEPS = 4e6  # before which hardly any run completes a lap
GUIDE = "docs/guide/race.md, When a policy does not learn"
CHANGES = {name: row.advice for name, row in TERMINATIONS.items()} | {
    OUT_OF_TIME: "raise training_limits.gate_inflation and learner.discount, or run.steps"
}
OWN_RULE = "check rules.extra"


def make_flights(config: Config, params: RaceParams) -> Callable[[Params], Laps]:
    """A function that flies the runs by which a policy is scored: ``Laps.score``.

    They start from hover and apply the mean action or sampled ones, or are episodes of the mean
    action from random starts (``run.score``).
    """
    environment, runs, race = make_environment(config), score_runs(config), config.evaluate
    act = act_sampled if config.run.score == "sampled" else act_deterministic

    def fly(networks: Params) -> Laps:
        local = jax.device_put(jax.device_get(networks), jax.local_devices()[0])
        policy, key = network_policy(config, local), jax.random.key(0)
        if config.run.score == "reward":
            return _episodes(environment, params, policy, runs)
        return fly_laps(environment, params, act, policy, key, race.laps, runs, gates=race.gates)[0]

    return fly


def _episodes(environment: Race, params: RaceParams, policy: object, runs: int) -> Laps:
    """Episodes of the mean action from random starts, until a crash or ``episode_steps``."""
    params, key = without_training_limits(environment.model, params), jax.random.key(0)
    states = flights.starting_states(environment, params, key, runs, from_hover=False)
    steps, dt = int(params.training_limits.episode_steps), float(params.rules.time_step)
    sizes = steps if params.track.closed else 1, steps, _rewards  # laps: more than there are
    start = params, policy, states, key
    flown, rewards = flights.fly_race(environment, act_deterministic, *sizes, *start)
    laps = flights.laps_of(environment, flown, dt, steps * dt)
    return dataclasses.replace(laps, reward=float(rewards.sum(axis=0).mean()))


def _rewards(
    environment: Race, params: RaceParams, flown: flights.LapState, action: jax.Array
) -> jax.Array:
    """The reward (runs,) of the next step; 0 after the end of an episode."""
    step = jax.vmap(lambda *x: environment.transition(params, *x)[1], in_axes=(-1, 0))
    return jnp.where(flown.over, 0.0, step(flown.state, action))


def score_runs(config: Config) -> int:
    """Number of runs that a score is the mean of.

    One run where every run is the same; 16 where noise, disturbances or charges are drawn; 128
    where starts are random, or constants, because the drones of the flights differ.
    """
    disturbed = any(value > 0 for value in config.disturbance.half_widths.values())
    charge = (1.0, 1.0) if config.battery is None else config.battery.charge
    sampled = config.run.score == "sampled" or charge[0] < charge[1]
    if config.run.score == "reward" or make_environment(config).randomize:
        return 128
    return 16 if sampled or disturbed else 1


def gap(config: Config, laps: Laps) -> dict[str, float]:
    """The metric ``gap`` to ``evaluate.best_known_lap``, where that is set: ``Laps.gap``."""
    best = config.evaluate.best_known_lap
    return {} if best is None else {"gap": laps.gap(best)}


def no_lap(crashes: Iterable[str], steps: float) -> str:
    """Why the flights of a policy that completes no race ended, and what to change.

    Args:
        crashes: why each flight ended: a name of ``quadjax.race.rules.TERMINATIONS``, or "".
        steps: environment steps of the training.

    Returns:
        Lines of at most 79 characters, or nothing if every flight completed its laps.
    """
    counts = Counter(reason for reason in crashes if reason)
    if not counts:
        return ""
    total = sum(counts.values())
    shares = ", ".join(f"{reason} ({n} of {total})" for reason, n in counts.most_common())
    advice = f"{CHANGES.get(counts.most_common(1)[0][0], OWN_RULE)}; see {GUIDE}"
    if steps < FEW_STEPS:
        advice = f"{steps:,.0f} steps are few: the first laps take some millions (run.steps)"
    lines = (f"no flight completes its laps yet: {shares}", advice)
    return "\n".join(textwrap.fill(line, 79, break_on_hyphens=False) for line in lines)
