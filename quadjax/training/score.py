"""The score of a policy during training: its timed laps."""

import jax
import numpy as np

from quadjax.config.race import choices_of
from quadjax.config.schema import Config
from quadjax.learners.networks import ActorCritic
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.race.environment import RaceParams
from quadjax.race.laps import fly_laps
from quadjax.training.build import network_policy


class Score:
    """``Laps.score`` of runs from hover: of the mean action, or sampled (``run.score``).

    One run where every run is the same; 16 where noise, disturbances or charges are drawn; 128
    where constants are, because the drones of the flights differ.
    """

    def __init__(self, config: Config, params: RaceParams) -> None:
        """Prepare the timed laps; nothing is simulated."""
        self._config, self._choices, self._params = config, choices_of(config), params
        self._runs = score_runs(config)
        self._act = act_sampled if config.run.score == "sampled" else act_deterministic
        self.crashes: tuple[str, ...] = ()  # of the latest runs
        self.fastest_lap = np.inf  # of the latest runs, s

    def __call__(self, params: ActorCritic) -> float:
        """The score of a policy, s."""
        local = jax.device_put(jax.device_get(params), jax.local_devices()[0])
        laps, _ = fly_laps(
            self._choices,
            self._params,
            self._act,
            network_policy(self._config, local),
            jax.random.key(0),
            self._config.evaluate.laps,
            self._runs,
            gates=self._config.evaluate.gates,
        )
        self.crashes = laps.crashes
        self.fastest_lap = float(np.nanmin(laps.whole_laps, initial=np.inf))
        return laps.score

    @property
    def metrics(self) -> dict[str, float]:
        """The gap to ``evaluate.best_known_lap``, a fraction, where that is set."""
        best = self._config.evaluate.best_known_lap
        return {} if best is None else {"gap": self.fastest_lap / best - 1.0}


def score_runs(config: Config) -> int:
    """Number of runs that a score is the mean of."""
    drawn = any(value > 0 for value in config.disturbance.half_widths.values())
    charge = (1.0, 1.0) if config.battery is None else config.battery.charge
    sampled = config.run.score == "sampled" or charge[0] < charge[1]
    if choices_of(config).randomize:
        return 128
    return 16 if sampled or drawn else 1
