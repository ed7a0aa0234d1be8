"""The navigation filter on known motions: its errors against its own covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from quadjax.plant.sensor_config import MocapConfig, SensorsConfig
from tests.plant.support import NO_ERRORS, ONLY_LATE, correlation, filtered, loop

pytestmark = pytest.mark.slow
GAPS = SensorsConfig(mocap=MocapConfig(dropout=0.6, dropout_frames=60.0))
SETTLED = 300  # samples: the loop does not start at rest, as the filter assumes


def worst(found, name):
    return np.abs(found.present[name][-1]).max()


@pytest.mark.parametrize(
    ("sensors", "seed"), [(SensorsConfig(), 2), (GAPS, 3)], ids=["short gaps", "long gaps"]
)
def test_errors_agree_with_the_covariance(sensors, seed):
    """At the delayed instant, through pitches of 90 deg and gaps of the motion capture."""
    assert np.abs(loop(np.arange(801) / 500.0)["attitude"][:, 1]).max() > np.pi
    found = filtered(sensors, seed)
    nees = found.nees[SETTLED:]
    assert 0.6 < nees.mean() / 15 < 1.2
    assert (nees < chi2.ppf(0.999, 15)).mean() > 0.97
    p = found.covariance
    np.testing.assert_array_equal(p, np.swapaxes(p, -1, -2))
    assert np.linalg.eigvalsh(correlation(p, p)).min() > 0
    if sensors is GAPS:  # some drones are in a gap now, and know it
        assert p[-1, :, 0, 0].max() > 9 * p[-1, :, 0, 0].min()
    else:
        assert worst(found, "velocity") < 0.2 and worst(found, "attitude") < 0.02


def test_an_overconfident_filter_is_not_consistent():
    nees = filtered(SensorsConfig(), 2, noise=0.001).nees
    assert nees[SETTLED:].mean() / 15 > 10.0


@pytest.mark.parametrize("config", [ONLY_LATE, NO_ERRORS], ids=["late", "exact"])
def test_without_noise_the_present_estimate_is_the_truth(config):
    """Also where poses and inertial samples are late: each corrects its own instant."""
    found = filtered(config, 0)
    speed, latency = 6.0, 0.02  # the pose that arrives is 12 cm old
    assert worst(found, "position") < 0.01 * speed * latency
    assert worst(found, "velocity") < 0.02 and worst(found, "attitude") < 2e-3
    assert worst(found, "rates") < 1e-3
