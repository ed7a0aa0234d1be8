"""Small learners on the probes, compiled once for all their tests."""

import functools

import jax
import numpy as np

from quadjax.core.traced import as_leaves
from quadjax.learners import parallel
from quadjax.learners.networks import ActorCritic, mean_action, predict_value
from quadjax.learners.ppo import PPO
from quadjax.learners.shac import SHAC
from quadjax.learners.state import Learner
from tests.learners.probes import ENVIRONMENT, NETWORK

UPDATES = 5  # of a chunk
_mean, _value = (jax.jit(functools.partial(f, NETWORK)) for f in (mean_action, predict_value))
DEFAULTS = {
    "ppo": PPO(
        num_envs=64,
        rollout_length=8,
        num_minibatches=2,
        num_epochs=2,
        learning_rate=5e-3,
        discount=0.5,
        gae_lambda=0.9,
        max_kl=1.0,
        initial_log_std=-1.0,
    ),
    "shac": SHAC(
        num_envs=64,
        horizon=4,
        critic_epochs=2,
        critic_minibatches=2,
        learning_rate=5e-3,
        critic_learning_rate=5e-3,
        td_lambda=0.9,
        discount=0.5,
        cotangent_decay=1.0,
        cotangent_clip=100.0,
        std=0.2,
        reward_scale=0.5,
    ),
}
DEFAULTS["muon"] = DEFAULTS["shac"].replace(optimizer="muon")


def network_of(name: str) -> ActorCritic:
    return NETWORK.clone(clip_mean=DEFAULTS[name].noise_on == "clipped_mean")


def make(name: str, **numbers: object) -> Learner:
    return DEFAULTS[name].replace(**numbers).make(ENVIRONMENT, network_of(name), 150)


@functools.cache
def _program(name: str, devices: int):
    """A chunk that takes its hyperparameters too: one program for every test."""
    learner = make(name)
    # Compiled soon rather than well: these networks are tiny.
    quick = {"xla_backend_optimization_level": 0}
    program = jax.jit(parallel.repeat(learner.update, UPDATES), compiler_options=quick)
    return learner, parallel.make_mesh(devices), program


class Run:
    """A learner in training on a probe."""

    def __init__(
        self,
        name: str,
        params: object,
        seed: int = 0,
        devices: int = 1,
        **numbers,
    ) -> None:
        self.learner, self.mesh, self.program = _program(name, devices)
        self.hyper = as_leaves(DEFAULTS[name].replace(**numbers))
        self.params = params
        state = jax.jit(self.learner.init)(self.hyper, params, jax.random.key(seed))
        self.state = parallel.place(state, self.mesh)

    def train(self, chunks: int) -> dict[str, np.ndarray]:
        for _ in range(chunks):
            with jax.set_mesh(self.mesh):
                self.state, metrics = self.program(self.hyper, self.params, self.state)
        return {name: np.asarray(value) for name, value in metrics.items()}

    def mean(self, observation: np.ndarray) -> float:
        return float(_mean(self.state.params, observation)[0])

    def value(self, observation: np.ndarray) -> float:
        return float(_value(self.state.params, observation))


def plain(tree: object) -> list[np.ndarray]:
    """Every leaf as NumPy, keys as their integers."""

    def leaf(x: jax.Array) -> np.ndarray:
        is_key = jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    return [leaf(x) for x in jax.tree.leaves(tree)]
