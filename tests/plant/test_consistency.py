"""The navigation filter on whole flights and on known motions."""

import numpy as np
import pytest

from benchmarks.consistency import COMPONENTS, LEAST_INSIDE, errors_in_deviations, evaluate_filter
from quadjax.core.resources import PRETRAINED
from quadjax.plant.config import (
    EkfConfig,
    MocapConfig,
    PlantConfig,
    SensorsConfig,
    without_effects,
)
from quadjax.plant.covariance import Covariance
from tests.plant.support import EXACT, NO_ERRORS, ONLY_LATE, at, correlation, filtered, loop

DRONES, SECONDS = 48, 3.0
FAST = EkfConfig(start_velocity=6.0)  # m/s: a loop does not start at rest
P, V, EULER, RATES, FORCE = range(5)


def evaluate(plant: PlantConfig, name: str, seconds: float = SECONDS):
    return evaluate_filter(without_effects(plant), PRETRAINED / name, DRONES, seconds)


@pytest.mark.slow
def test_errors_stay_within_three_standard_deviations():
    result = evaluate(PlantConfig(), "e2e.npz")
    assert result.samples > 0.8 * DRONES * SECONDS * PlantConfig().sample_rate
    assert result.diverged == 0
    assert (result.inside > 0.97).all()  # of few flights; 0.99 of a thousand
    # The standard deviations are not merely large: errors are a good part of them.
    assert (result.ratio > 0.15).all() and (result.ratio < 1.5).all()
    position, velocity, euler = result.rmse[:3]
    assert position.max() < 0.001 and velocity.max() < 0.02 and euler.max() < 0.005


@pytest.mark.slow
def test_an_overconfident_filter_fails():
    overconfident = PlantConfig(
        sensors=SensorsConfig(mocap=MocapConfig(position_noise=0.0)),
        ekf=EkfConfig(start_velocity=1e-3, accelerometer_noise=0.0),
    )
    result = evaluate(overconfident, "e2e.npz", 1.0)
    assert result.inside.min() < LEAST_INSIDE


@pytest.mark.slow
def test_delayed_poses_correct_the_instant_at_which_they_were_taken():
    numbers, _ = filtered(ONLY_LATE, EXACT, loop(801, DRONES), 0)
    errors, deviations = np.abs(numbers[-1])
    speed = 6.0  # m/s: the pose that arrives is 12 cm old
    assert errors[P].max() < 0.01 * speed * 0.02
    assert errors[V].max() < 0.02
    assert errors[EULER].max() < 2e-3
    assert errors[RATES].max() < 1e-3 and errors[FORCE].max() < 0.2
    assert (deviations > 0).all()


@pytest.mark.slow
def test_pitch_of_90_deg_is_no_singularity():
    truth = loop(801, DRONES)
    assert np.abs(truth.euler.y).max() > 1.56
    numbers, _ = filtered(SensorsConfig(), FAST, truth, 2)
    assert np.abs(numbers[-1, 0, V]).max() < 0.2 and np.abs(numbers[-1, 0, EULER]).max() < 0.02
    assert (errors_in_deviations(numbers)[:, V] < 3.0).mean() > 0.99


@pytest.mark.slow
def test_covariance_stays_symmetric_and_positive_through_long_gaps():
    gaps = SensorsConfig(mocap=MocapConfig(dropout=0.6, dropout_frames=60.0))
    numbers, filters = filtered(gaps, FAST, loop(801, DRONES), 4)
    for index in range(DRONES):
        p = np.float64(Covariance.array(at(filters.covariance, (..., index))))
        np.testing.assert_array_equal(p, p.T)
        assert np.linalg.eigvalsh(correlation(p, p)).min() > 0
    spread = numbers[-1, 1, P, 0] ** 2
    assert spread.max() > 9 * spread.min()  # some are in a gap now, and estimate it
    assert (errors_in_deviations(numbers[-1]) < 3.0).mean() > 0.98


@pytest.mark.slow
def test_without_sensor_errors_the_estimate_is_the_truth():
    exact = PlantConfig(sensors=NO_ERRORS, ekf=EXACT)
    result = evaluate(exact, "e2e.npz", 1.0)
    limits = {
        "position": 1e-4,
        "velocity": 1e-2,
        "euler": 1e-3,
        "rates": 2e-3,
        "specific_force": 3e-2,
    }
    for name, limit in limits.items():
        assert result.rmse[COMPONENTS.index(name)].max() < limit, name
