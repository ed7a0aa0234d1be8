import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadjax.plant import ekf
from quadjax.plant.ekf import ekf_params
from quadjax.plant.sensor_config import SensorsConfig
from quadjax.plant.sensors import Fix
from tests.plant import reference
from tests.plant.support import (
    RATE,
    correlation,
    motion_of,
    nominal_of,
    quaternion_of,
    random_filter,
    vec3,
)

SEEDS = range(2)


@pytest.fixture(scope="module")
def params():
    return ekf_params(SensorsConfig(), RATE)


def _mean(samples):
    return (
        np.float64((a.array() + b.array()) / 2)
        for a, b in zip(*((s.gyro, s.force) for s in samples), strict=True)
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_prediction_agrees_with_the_float64_reference(params, seed):
    state, dense, samples = random_filter(seed)
    motion, covariance = ekf.predict(
        params, motion_of(state), jnp.asarray(dense, jnp.float32), *samples
    )
    added = np.diag(params.noise)[3::3] * RATE  # variances per second
    densities = dict(zip(("force", "gyro", "gyro_walk", "force_walk"), added, strict=True))
    expected, grown = reference.predict(state, dense, *_mean(samples), 1.0 / RATE, densities)
    assert np.abs(nominal_of(motion).minus(expected)).max() < 3e-6
    got = np.float64(covariance)
    # Terms of the second order in the step are left out of the transition on purpose.
    assert np.abs(correlation(got - grown, grown)).max() < 1e-3
    assert np.abs(correlation(grown - dense, grown)).max() > 0.01  # and there was much to agree on


def _fix(state, seed, fresh=1.0):
    random = np.random.default_rng(seed + 100)
    position = state.position + 2e-3 * random.normal(size=3)
    attitude = Rotation.from_rotvec(5e-3 * random.normal(size=3)) * state.attitude
    return position, attitude, Fix(vec3(position), quaternion_of(attitude), jnp.float32(fresh))


@pytest.mark.parametrize("seed", SEEDS)
def test_correction_agrees_with_the_float64_reference(params, seed):
    state, dense, samples = random_filter(seed)
    position, attitude, fix = _fix(state, seed)
    exact = params.replace(offset=jnp.float32(0.0))
    motion, covariance = ekf.correct(
        exact, motion_of(state), jnp.asarray(dense, jnp.float32), samples[1], fix
    )
    variances = (float(params.pose_variance[0]), float(params.pose_variance[3]))
    expected, after = reference.correct(state, dense, position, attitude, variances)
    error = nominal_of(motion).minus(expected) / np.sqrt(np.diag(after))
    assert np.abs(error).max() < 5e-3
    got = np.float64(covariance)
    assert np.abs(correlation(got - after, after)).max() < 1e-4
    np.testing.assert_array_equal(got, got.T)
    assert np.linalg.eigvalsh(correlation(got, got)).min() > 0
    assert (np.diag(got)[:3] < 0.7 * np.diag(dense)[:3]).all()


@pytest.mark.parametrize(
    ("taken", "offset", "fresh", "least", "most"),  # s, s, -, standard deviations
    [
        (8e-4, 8e-4, 1.0, 0.0, 2e-3),  # the pose says what was known already
        (-8e-4, -8e-4, 1.0, 0.0, 2e-3),
        (8e-4, 0.0, 1.0, 0.1, np.inf),
        (8e-4, 0.0, 0.0, 0.0, 1e-5),
    ],
    ids=["later", "earlier", "not bridged", "lost"],
)
def test_a_pose_between_samples_is_bridged_and_a_lost_one_changes_nothing(
    params, taken, offset, fresh, least, most
):
    state, dense, samples = random_filter(7)
    gyro, force = (np.float64(v.array()) for v in (samples[1].gyro, samples[1].force))
    then = reference.advance(state, gyro, force, taken)
    fix = Fix(vec3(then.position), quaternion_of(then.attitude), jnp.float32(fresh))
    before, covariance = motion_of(state), jnp.asarray(dense, jnp.float32)
    bridging = params.replace(offset=jnp.float32(offset))
    motion, after = ekf.correct(bridging, before, covariance, samples[1], fix)
    change = np.abs(nominal_of(motion).minus(nominal_of(before))) / np.sqrt(np.diag(dense))
    assert least <= change.max() < most
    assert np.allclose(after, covariance, rtol=1e-7, atol=0.0) == (fresh == 0.0)
