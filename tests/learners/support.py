"""Small learners on the probes, compiled once for all their tests."""

import functools

import jax
import numpy as np

from quadjax.core.traced import as_leaves
from quadjax.learners import parallel
from quadjax.learners.networks import ActorCritic, mean_action, predict_value
from quadjax.learners.ppo import PPO
from quadjax.learners.schedules import Training
from quadjax.learners.shac import SHAC
from quadjax.learners.state import Task
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


@functools.cache
def _program(devices: int):
    """A chunk of any training: one program for every test of a learner and a number of devices."""
    # Compiled soon rather than well: these networks are tiny.
    quick = {"xla_backend_optimization_level": 0}
    return parallel.make_mesh(devices), jax.jit(
        parallel.repeat, static_argnums=2, compiler_options=quick
    )


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
        self.mesh, self.program = _program(devices)
        task = Task.of(ENVIRONMENT, network_of(name), params)
        self.training = Training(as_leaves(DEFAULTS[name].replace(**numbers)), task)
        state = jax.jit(Training.init)(self.training, jax.random.key(seed))
        self.state = parallel.place(state, self.mesh)

    def change(self, params: object = None, **numbers: object) -> None:
        """Other numbers of the environment, or of the learner, which are not validated."""
        training = self.training
        task = training.task if params is None else training.task.replace(env_params=params)
        self.training = training.replace(task=task, learner=training.learner.replace(**numbers))

    def train(self, chunks: int) -> dict[str, np.ndarray]:
        for _ in range(chunks):
            with jax.set_mesh(self.mesh):
                self.state, metrics = self.program(self.training, self.state, UPDATES)
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
