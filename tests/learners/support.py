"""Small learners on the probes, compiled once for all their tests."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.learners import sharding as parallel
from quadjax.learners.ppo import update as ppo
from quadjax.learners.shac import update as shac
from quadjax.learners.state import Learner
from tests.learners.probes import ENVIRONMENT, NETWORKS, probe

ENVIRONMENTS = 64
UPDATES = 5  # of a chunk
WHOLE = 150  # of a run


def ppo_hyper(**numbers: float) -> ppo.Hyper:
    values = {
        "learning_rate": 1e-2,
        "final_learning_rate": 1e-3,
        "adam_epsilon": 1e-5,
        "discount": 0.5,
        "gae_lambda": 0.9,
        "clip": 0.2,
        "value_coefficient": 0.5,
        "entropy_coefficient": 0.0,
        "gradient_norm": 0.5,
        "kl_limit": 1.0,
        "reward_scale": 1.0,
        "warm_up": 0,
    }
    return ppo.Hyper(**{k: jnp.float32(v) for k, v in (values | numbers).items()})


def shac_hyper(**numbers: float) -> shac.Hyper:
    values = {
        "learning_rate": 1e-2,
        "final_learning_rate": 1e-3,
        "adam_b1": 0.7,
        "adam_b2": 0.95,
        "gradient_norm": 1.0,
        "critic_learning_rate": 1e-2,
        "critic_gradient_norm": 1.0,
        "critic_target_rate": 0.3,
        "td_lambda": 0.9,
        "discount": 0.5,
        "final_discount": 0.5,
        "state_gradient_decay": 1.0,
        "state_gradient_clip": 100.0,
        "std": 0.3,
        "final_std": 0.1,
        "reward_scale": 0.5,
        "mean_rate": 1.0,
        "warm_up": 0,
    }
    return shac.Hyper(**{k: jnp.float32(v) for k, v in (values | numbers).items()})


def make(name: str, **numbers: float) -> Learner:
    if name == "ppo":
        structure = ppo.Structure(ENVIRONMENTS, 8, 2, 2, WHOLE)
        return ppo.make_learner(ENVIRONMENT, NETWORKS, structure, ppo_hyper(**numbers))
    structure = shac.Structure(ENVIRONMENTS, 4, 2, 2, WHOLE)
    bounded = dataclasses.replace(NETWORKS, bounded=True)
    return shac.make_learner(ENVIRONMENT, bounded, structure, shac_hyper(**numbers))


@functools.cache
def _program(name: str, devices: int):
    """A chunk that takes its hyperparameters too: one program for every test."""
    learner = make(name)
    mesh = parallel.make_mesh(devices)
    state = parallel.place(jax.jit(learner.init)(learner.hyper, probe(), jax.random.key(0)), mesh)
    specs = parallel.specs_of(state)
    everywhere = jax.sharding.PartitionSpec()

    def many(hyper, params, state):
        return jax.lax.scan(
            lambda carry, _: learner.update(hyper, params, carry), state, None, UPDATES
        )

    split = jax.shard_map(
        many,
        mesh=mesh,
        in_specs=(everywhere, everywhere, specs),
        out_specs=(specs, everywhere),
        check_vma=False,
    )
    # Compiled soon rather than well: these networks are tiny.
    return learner, mesh, jax.jit(split, compiler_options={"xla_backend_optimization_level": 0})


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
        self.learner, mesh, self.program = _program(name, devices)
        self.hyper = {"ppo": ppo_hyper, "shac": shac_hyper}[name](**numbers)
        self.params = params
        state = jax.jit(self.learner.init)(self.hyper, params, jax.random.key(seed))
        self.state = parallel.place(state, mesh)

    def train(self, chunks: int) -> dict[str, np.ndarray]:
        for _ in range(chunks):
            self.state, metrics = self.program(self.hyper, self.params, self.state)
        return {name: np.asarray(value) for name, value in metrics.items()}

    def mean(self, observation: jax.Array) -> float:
        return float(NETWORKS.mean(self.state.params, observation)[0])

    def value(self, observation: jax.Array) -> float:
        return float(NETWORKS.evaluate(self.state.params, observation))


def plain(tree: object) -> list[np.ndarray]:
    """Every leaf as NumPy, keys as their integers."""

    def leaf(x: jax.Array) -> np.ndarray:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    return [leaf(x) for x in jax.tree.leaves(tree)]
