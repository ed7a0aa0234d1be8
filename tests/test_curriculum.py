"""What changes while a policy trains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from quadjax.config.loading import load_config
from quadjax.core.vectors import Rotors, Vec3
from quadjax.learners.state import Learner
from quadjax.race.build import build_params
from quadjax.training.build import build_learner
from quadjax.training.curriculum import Curriculum, curriculum_of, follow, ramp, with_residual_share
from quadjax.vehicle.residual import residual_force_moment, scale_residual
from tests.convert import residual_of
from tests.reference import random_residual
from tests.test_training import CONFIGS, TINY

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
    assert float(ramp(jnp.float32(steps), (begin, end))) == share


def config_of(*words):
    short = ("train.devices=1", "train.residual_ramp=[0, 0]", "train.yaw_ramp=[0, 0]")
    return load_config(CONFIGS / "e2e.yaml", [*TINY, *short, *words])


RAMPED = config_of("train.residual_ramp=[128, 384]", "train.nose_up_price=3")


@struct.dataclass
class State:
    """What of a run's state the curriculum looks at."""

    update: jax.Array


def test_the_learner_flies_in_the_race_of_its_step():
    def begin(hyper, params, key):
        return params.start.yaw

    def update(hyper, params, state):
        force, _ = residual_force_moment(params.vehicle.residual, RPM, VELOCITY, RATES)
        price = params.reward.nose_up
        return state, {"force": hyper * force, "yaw": params.start.yaw, "nose_up": price}

    plain = Learner(begin, update, hyper=jnp.float32(2.0), steps_per_update=64, num_shards=1)
    learner = follow(plain, Curriculum((128, 384), (0, 256)))
    params = build_params(RAMPED)
    force, yaw = 2.0 * outputs(params.vehicle.residual)[0], float(params.start.yaw)
    assert yaw == pytest.approx(np.pi)
    assert float(learner.init(None, params, None)) == 0.0
    assert float(follow(plain, Curriculum()).init(None, params, None)) == params.start.yaw
    shares = {0: (0, 0), 1: (0, 0.25), 2: (0, 0.5), 3: (0.25, 0.75), 4: (0.5, 1), 6: (1, 1)}
    for done, (of_force, of_yaw) in (shares | {100: (1, 1)}).items():
        _, metrics = jax.jit(learner.update)(learner.hyper, params, State(jnp.int32(done)))
        np.testing.assert_allclose(metrics["force"], of_force * force, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(metrics["yaw"], of_yaw * yaw, rtol=1e-6)
        assert float(metrics["nose_up"]) == 3.0 * (1.0 - of_yaw)


def test_the_price_of_an_edge_rises():
    params = build_params(config_of("reward.edge=40"))
    rising = Curriculum(edge=(100.0, 300.0))
    for steps, price in ((0, 0.0), (100, 0.0), (250, 30.0), (300, 40.0), (1e9, 40.0)):
        assert float(rising.at(params, jnp.float32(steps)).reward.edge) == price
    assert float(Curriculum().at(params, jnp.float32(0)).reward.edge) == 40.0


def test_the_price_of_a_nose_that_is_up_fades():
    params = build_params(config_of("train.nose_up_price=2"))
    assert float(params.reward.nose_up) == 0 and params.start.facing is None
    fading = Curriculum(yaw=(100.0, 300.0))
    for steps, price in ((0, 2.0), (100, 2.0), (250, 0.5), (300, 0.0), (1e9, 0.0)):
        assert float(fading.at(params, jnp.float32(steps)).reward.nose_up) == price
    assert float(Curriculum().at(params, jnp.float32(0)).reward.nose_up) == 0.0


def test_every_ramp_of_a_config_has_its_place():
    ramps = {"residual": [0, 9], "yaw": [1, 10], "edge": [2, 11]}
    words = [f"train.{key}_ramp={span}" for key, span in ramps.items()]
    assert curriculum_of(config_of(*words)) == Curriculum((0, 9), (1, 10), (2, 11))


def test_the_estimator_believes_in_the_same_share():
    params = build_params(config_of("episode.disturbance_input=estimated"))
    half = with_residual_share(params, jnp.float32(0.5))
    np.testing.assert_allclose(
        outputs(half.estimator.vehicle.residual), 0.5 * outputs(params.vehicle.residual), rtol=1e-5
    )


def test_a_config_s_ramps_reach_its_learner():
    words = ("vehicle.residual=null", "train.residual_ramp=[1, 2]", "start.position=0")
    for ramped, least, most in (("[0, 0]", 0.5, 4.0), ("[0, 9]", 0.0, 1e-5)):
        config = config_of(*words, f"train.yaw_ramp={ramped}")
        learner, params = build_learner(config), build_params(config)
        begun = jax.jit(learner.init)(learner.hyper, params, jax.random.key(0)).environment
        inside = np.radians([90.0, 180.0, 270.0, 0.0])  # of the legs to the paper's four gates
        off = np.asarray(begun.drone.euler.z) - inside[np.asarray(begun.target)]
        off = np.abs(np.angle(np.exp(1j * off)))
        assert least <= off.max() <= most and off.shape == (16,)
