import numpy as np
import pytest

from benchmarks.recovery import constant_errors, exact_motion, residual_recovered
from quadjax.fitting.nominal import nominal
from quadjax.fitting.residual import zero_residual
from quadjax.fitting.simulate import random_residual
from quadjax.vehicle.protocol import VehicleParams

from .flights import RATE, SECONDS


@pytest.fixture(scope="module")
def flown(bebop):
    vehicle = VehicleParams(bebop, random_residual(5, 1.0, 0.005))
    return vehicle, exact_motion(vehicle, 1000, SECONDS, RATE)


def test_the_truth_is_recovered_and_nothing_is_not(bebop, flown):
    vehicle, motion = flown
    whole = residual_recovered(vehicle, bebop, vehicle.residual, motion)
    np.testing.assert_allclose(whole, 1.0, atol=1e-9)
    assert (residual_recovered(vehicle, bebop, zero_residual(bebop).residual, motion) < 0.01).all()


def test_what_the_nominal_model_takes_over_counts(bebop, flown):
    """A residual less ten per cent of thrust is as good where the constants make up for it."""
    vehicle, motion = flown
    more = bebop.replace(k_w=1.1 * bebop.k_w)
    lost = residual_recovered(vehicle, more, vehicle.residual, motion)
    assert lost[0] < 0.5 and (lost[1:] > 0.999).all()


def test_the_motion_is_the_simulations_own(bebop, flown):
    """Without noise the model's specific force is what the accelerometer says, without a bias."""
    _, motion = flown
    assert len(motion.rpm) == 200
    force = nominal(bebop, motion)[:, 2]
    assert -14.0 < np.median(force) < -7.0 and np.ptp(motion.rpm_rate) > 100.0


def test_errors_are_relative_and_in_standard_errors(bebop):
    found = bebop.replace(k_w=1.01 * bebop.k_w)
    errors = constant_errors(
        bebop, found, dict.fromkeys(vars(bebop), 1.0) | {"k_w": 0.01 * bebop.k_w}
    )
    np.testing.assert_allclose(errors["k_w"], (0.01, 1.0), rtol=1e-6)
    assert errors["tau"] == (0.0, 0.0)
