"""The flights by which a policy is scored during training: its timed laps."""

from collections.abc import Callable

import jax
import numpy as np

from quadjax.config.race import choices_of
from quadjax.config.schema import Config
from quadjax.learners.state import ActorCritic
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.race.environment import RaceParams
from quadjax.race.laps import Laps, fly_laps
from quadjax.training.build import network_policy


def make_flights(config: Config, params: RaceParams) -> Callable[[ActorCritic], Laps]:
    """A function that flies the runs by which a policy is scored: ``Laps.score``.

    They start from hover and apply the mean action or sampled ones (``run.score``).
    """
    choices, runs, race = choices_of(config), score_runs(config), config.evaluate
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
    if choices_of(config).randomize:
        return 128
    return 16 if sampled or disturbed else 1


def gap(config: Config, laps: Laps) -> dict[str, float]:
    """The metric ``gap`` of the fastest lap to ``evaluate.best_known_lap``, where that is set.

    It is the fraction by which the lap is slower.
    """
    best = config.evaluate.best_known_lap
    fastest = float(np.nanmin(laps.whole_laps, initial=np.inf))
    return {} if best is None else {"gap": fastest / best - 1.0}
