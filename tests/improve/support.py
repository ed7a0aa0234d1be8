"""A tiny race, an untrained policy for it, and logs of a simulated drone."""

import numpy as np

from quadjax.config.loading import load_config
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.flight_log import write_log
from quadjax.training.build import untrained_policy
from tests.fitting.flights import simulated
from tests.race.support import BLANK

TINY = (
    *("learner.algorithm=shac", "learner.num_envs=8", "learner.critic_minibatches=2"),
    *("learner.horizon=4", "learner.learning_rate=0.004"),
    *("network.hidden=[8]", "evaluate.laps=1"),
)
STEPS = 64
FIT = load_fit_config("improve", ["residual={fit: false, seeds: 5}"])


def race(*overrides):
    return load_config(BLANK, [*TINY, *overrides])


def policy_file(folder, config=None):
    path = folder / "first.npz"
    untrained_policy(config or race()).save(path)
    return path


def drone_log(path, seed: int):
    """A log of a drone with 10% less thrust and roll moment, and 10% more drag, than the Bebop."""
    write_log(path, simulated(seed, noise=1.0, k_w=0.9, k_p=0.9, k_x=1.1))
    return path


def around_the_track(config, laps: int = 2, rate: float = 100.0) -> np.ndarray:
    """Positions (n, 3) on straight legs of one second through the gates, from the last one."""
    centers = np.array([gate.position for gate in config.track.gates])
    points = np.concatenate([centers[-1:], *[centers] * laps])
    time = np.arange(0.0, len(points) - 1.0, 1.0 / rate)
    return np.stack([np.interp(time, np.arange(len(points)), x) for x in points.T], axis=1)
