"""Functions and learners with mistakes, for tests of what is said about them."""

import sys

import jax.numpy as jnp
import optax

from quadjax import Field, Learner, LearnerSection, TrainState


def vector(step):
    return jnp.zeros(4)


def attribute(step):
    return step.nosuch


THREE = Field("three", 1, "m", "world", value=lambda view: [0.0] * 3)


def learner(init, update):
    class Own(LearnerSection):
        def make(self, environment, networks, num_updates):
            def begin(hyper, params, key):
                w = networks.init(key)
                adam = optax.adam(1e-3).init(w)
                return TrainState(w, adam, None, (), key, jnp.int32(0))

            return Learner(init or begin, update, {}, 64)

    return Own


class NoLearner(LearnerSection):
    def make(self, environment, networks, num_updates):
        return None


NO_STATE = learner(lambda hyper, params, key: 3, lambda hyper, params, state: state)
NO_METRICS = learner(None, lambda hyper, params, state: (state,))
LEAVES = learner(None, lambda hyper, params, state: sys.exit(3))
DIVIDES = learner(None, lambda hyper, params, state: (state, {"reward": 1 / 0}))
