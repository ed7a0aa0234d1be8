"""What changes while a policy trains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from quadjax.config import load_config
from quadjax.curriculum import ramp, ramp_residual, with_residual_share
from quadjax.learn.state import Learner
from quadjax.learners import build_learner
from quadjax.many import shape_of
from quadjax.race.build import build_params
from quadjax.vehicle.residual import residual_force_moment, scale_residual
from quadjax.vehicle.vector import Rotors, Vec3
from tests.convert import residual_of
from tests.reference import random_residual
from tests.test_training import CONFIGS, TINY

BEGIN, END = 128.0, 384.0
RPM = Rotors(*(jnp.float32(x) for x in (4000.0, 6000.0, 8000.0, 9000.0)))
VELOCITY = Vec3(*(jnp.float32(x) for x in (8.0, -2.0, 1.0)))
RATES = Vec3(*(jnp.float32(x) for x in (1.0, -3.0, 2.0)))


def outputs(residual):
    force, moment = residual_force_moment(residual, RPM, VELOCITY, RATES)
    return np.array([force, moment.x, moment.y, moment.z])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_share_of_a_residual_is_that_share_of_its_outputs(sign, share):
    whole = residual_of(random_residual(sign))
    found = outputs(scale_residual(whole, share))
    np.testing.assert_allclose(found, share * outputs(whole), rtol=1e-5, atol=1e-7)
    assert np.all(np.abs(outputs(whole)) > 1e-4)


@pytest.mark.parametrize(
    ("steps", "begin", "end", "share"),
    [(0, 0, 0, 1), (0, 10, 20, 0), (10, 10, 20, 0), (15, 10, 20, 0.5), (20, 10, 20, 1)]
    + [(9, 10, 10, 0), (10, 10, 10, 1), (1e9, 10, 20, 1)],
)
def test_ramp(steps, begin, end, share):
    assert float(ramp(jnp.float32(steps), begin, end)) == share


def config_of(*words):
    return load_config(CONFIGS / "e2e.yaml", [*TINY, "train.devices=1", *words])


RAMPED = config_of(f"train.residual_ramp=[{BEGIN}, {END}]")


@struct.dataclass
class State:
    """What of a run's state the curriculum looks at."""

    update: jax.Array


def test_the_learner_flies_with_the_share_of_its_step():
    def update(hyper, params, state):
        force, _ = residual_force_moment(params.vehicle.residual, RPM, VELOCITY, RATES)
        return state, {"force": hyper * force}

    plain = Learner(None, update, hyper=jnp.float32(2.0), steps_per_update=64, lanes=1)
    learner, params = ramp_residual(plain, BEGIN, END), build_params(RAMPED)
    whole = 2.0 * outputs(params.vehicle.residual)[0]
    shares = {0: 0.0, 1: 0.0, 2: 0.0, 3: 0.25, 4: 0.5, 6: 1.0, 100: 1.0}
    for done, share in shares.items():
        _, metrics = jax.jit(learner.update)(learner.hyper, params, State(jnp.int32(done)))
        np.testing.assert_allclose(metrics["force"], share * whole, rtol=1e-5, atol=1e-6)


def test_the_estimator_believes_in_the_same_share():
    params = build_params(config_of("episode.disturbance_input=estimated"))
    half = with_residual_share(params, jnp.float32(0.5))
    np.testing.assert_allclose(
        outputs(half.estimator.vehicle.residual), 0.5 * outputs(params.vehicle.residual), rtol=1e-5
    )


def test_runs_with_and_without_a_ramp_are_of_different_programs():
    assert shape_of(RAMPED) != shape_of(config_of("train.residual_ramp=[0, 0]"))
    assert shape_of(RAMPED) == shape_of(config_of("train.residual_ramp=[7, 9]"))


def test_a_ramp_without_a_residual_is_no_ramp():
    learner = build_learner(config_of("vehicle.residual=null", "train.residual_ramp=[1, 2]"))
    assert not hasattr(learner.hyper, "begin")
    assert hasattr(build_learner(RAMPED).hyper, "begin")
