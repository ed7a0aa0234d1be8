"""The inner loop: what it asks of the motors, what gives way first, and how fast it is."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.identify import EXPECTED, responses
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import indi
from quadjax.plant.config import IndiConfig, PlantConfig, without_effects
from tests import reference as ref
from tests.convert import constants

CONFIG = IndiConfig()
SIGNS = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [-1, 1, -1, 1]], float)


@pytest.fixture(scope="module")
def params():
    return indi.indi_params(constants("motor", ref.MOTOR), CONFIG, 500.0)


@functools.cache
def compiled_allocate():
    return jax.jit(indi.allocate)


def allocate(params, rpm, wanted, rise):
    speeds, turn = (x.astype(np.float32) for x in (np.asarray(rpm, float), np.asarray(wanted)))
    found = compiled_allocate()(
        params, Rotors(*map(jnp.asarray, speeds)), Vec3(*map(jnp.asarray, turn)), jnp.float32(rise)
    )
    return np.array([float(x) for x in found.components()])


def made(rpm, commands):
    """What commands do, from the model's equations: lagged turns, yaw at once, rise of thrust."""
    c, rpm = ref.MOTOR, np.asarray(rpm, float)
    change = (commands - rpm) / c["tau"]
    roll = 2.0 * c["k_p"] / c["i_xx"] * (SIGNS[0] * rpm * change).sum() * CONFIG.moment_lag
    pitch = 2.0 * c["k_q"] / c["i_yy"] * (SIGNS[1] * rpm * change).sum() * CONFIG.moment_lag
    yaw = c["k_r2"] / c["i_zz"] * (SIGNS[2] * change).sum()
    return np.array([roll, pitch, yaw]), 2.0 * c["k_w"] * (rpm * change).sum()


@pytest.mark.parametrize("rpm", [[7497.0] * 4, [6500.0, 7000.0, 8200.0, 7600.0]])
def test_what_fits_is_given(params, rpm):
    wanted, rise = np.array([8.0, -6.0, 5.0]), 20.0
    found, lifted = made(rpm, allocate(params, rpm, wanted, rise))
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-2)
    assert lifted == pytest.approx(rise, rel=5e-3)


def test_yaw_gives_way_first_then_thrust(params):
    rpm = [9000.0] * 4
    wanted = np.array([8.0, 4.0, 500.0])
    found, lifted = made(rpm, allocate(params, rpm, wanted, 20.0))
    np.testing.assert_allclose(found[:2], wanted[:2], rtol=5e-3)
    assert lifted == pytest.approx(20.0, rel=5e-3) and 0.5 < found[2] < 100.0
    found, lifted = made(rpm, allocate(params, rpm, np.array([40.0, 0.0, 0.0]), 5000.0))
    np.testing.assert_allclose(found[0], 40.0, rtol=5e-3)
    assert lifted < 0.0  # asked to rise by 5000 m/s^3


def test_a_turn_too_large_keeps_its_direction(params):
    rpm = [7497.0] * 4
    wanted = np.array([3000.0, 1500.0, 0.0])
    commands = allocate(params, rpm, wanted, 0.0)
    assert commands.min() >= 3000.0 and commands.max() <= 11000.0
    found, _ = made(rpm, commands)
    assert 0 < found[0] < 3000.0
    assert found[0] / found[1] == pytest.approx(2.0, rel=1e-2)


def test_limits_of_equal_speeds_are_finite(params):
    """Without a change of yaw, and with rounding beyond the limits."""
    rng = np.random.default_rng(0)
    rpm, roll = rng.uniform(3000, 11000, 20_000), rng.uniform(-2000, 2000, 20_000)
    zero = jnp.zeros(())

    def commands(rpm, roll):
        return indi.allocate(params, Rotors.same(rpm), Vec3(roll, zero, zero), zero)

    found = jax.jit(jax.vmap(commands))(np.float32(rpm), np.float32(roll)).array()
    assert np.isfinite(found).all()


@pytest.mark.slow
def test_the_loop_is_as_fast_as_training_assumes():
    """On the nominal plant, for steps that the motors can follow."""
    sizes = {"p": (1.0, -2.0), "q": (1.0, -2.0), "r": (0.5, -1.0), "T": (8.0, 12.0)}
    for step in responses(without_effects(PlantConfig()), sizes):
        assert EXPECTED[0] <= step.tau <= EXPECTED[1], (step.axis, step.target, step.tau)
        assert step.error < 0.1
