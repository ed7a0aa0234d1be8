"""The flights by which a policy is scored during training, and advice where none is complete."""

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable

import jax
import numpy as np

from quadjax.config.assembly import make_choices
from quadjax.config.schema import Config
from quadjax.learners.state import ActorCritic
from quadjax.policy.inference import act_deterministic, act_sampled
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


def make_flights(config: Config, params: RaceParams) -> Callable[[ActorCritic], Laps]:
    """A function that flies the runs by which a policy is scored: ``Laps.score``.

    They start from hover and apply the mean action or sampled ones (``run.score``).
    """
    choices, runs, race = make_choices(config), score_runs(config), config.evaluate
    act = act_sampled if config.run.score == "sampled" else act_deterministic

    def fly(networks: ActorCritic) -> Laps:
        local = jax.device_put(jax.device_get(networks), jax.local_devices()[0])
        policy, key = network_policy(config, local), jax.random.key(0)
        return fly_laps(choices, params, act, policy, key, race.laps, runs, gates=race.gates)[0]

    return fly


def score_runs(config: Config) -> int:
    """Number of runs that a score is the mean of.

    One run where every run is the same; 16 where noise, disturbances or charges are drawn; 128
    where constants are, because the drones of the flights differ.
    """
    disturbed = any(value > 0 for value in config.disturbance.half_widths.values())
    charge = (1.0, 1.0) if config.battery is None else config.battery.charge
    sampled = config.run.score == "sampled" or charge[0] < charge[1]
    if make_choices(config).randomize:
        return 128
    return 16 if sampled or disturbed else 1


def gap(config: Config, laps: Laps) -> dict[str, float]:
    """The metric ``gap`` of the fastest lap to ``evaluate.best_known_lap``, where that is set.

    It is the fraction by which the lap is slower.
    """
    best = config.evaluate.best_known_lap
    fastest = float(np.nanmin(laps.whole_laps, initial=np.inf))
    return {} if best is None else {"gap": fastest / best - 1.0}


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
