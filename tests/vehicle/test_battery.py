"""The onboard estimate of the highest propeller speed that a battery permits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.vectors import Rotors
from quadjax.vehicle import battery

HIGHEST, LAG, STEP = 11000.0, 0.06, 0.01


@functools.cache
def _estimated(first: float, top: float, low: float) -> np.ndarray:
    """Estimates (n,) while commands alternate between the highest and a low one, s each 0.3."""
    params = battery.limit_estimator(HIGHEST, LAG, 1.0 / STEP)
    commands = np.where(np.arange(300) // 30 % 2 == 0, HIGHEST, low)
    begin = Rotors.same(jnp.float32(7000.0))

    def one(carry, command):
        rpm, state = carry
        sent = Rotors.same(command)
        reached = jax.tree.map(lambda u: jnp.minimum(u, top), sent)
        rpm = rpm + (reached - rpm) * (STEP / LAG)  # explicit Euler, as in training
        state = battery.update(params, state, rpm, sent)
        return (rpm, state), state.highest

    start = (begin, battery.begin(params, begin, jnp.float32(first)))
    return np.asarray(jax.lax.scan(one, start, jnp.asarray(commands, jnp.float32))[1])


@pytest.mark.parametrize("first", [9000.0, 9700.0, 11000.0])
def test_it_finds_the_limit_from_any_first_estimate(first):
    found = _estimated(first, 9700.0, 4000.0)
    assert found[-1] == pytest.approx(9700.0, rel=2e-3)


def test_a_correct_estimate_stays_exact_while_speeds_change():
    np.testing.assert_allclose(_estimated(9700.0, 9700.0, 4000.0), 9700.0, rtol=1e-4)


def test_a_full_battery_is_seen_and_the_estimate_stays_within_its_range():
    found = _estimated(9000.0, 20000.0, 4000.0)
    assert found[-1] == pytest.approx(HIGHEST, rel=1e-3) and found.max() <= HIGHEST
    assert _estimated(9000.0, 3000.0, 3000.0).min() >= battery.LOWEST * HIGHEST


def test_commands_below_the_limit_change_nothing():
    params = battery.limit_estimator(HIGHEST, LAG, 1.0 / STEP)
    slow = Rotors.same(jnp.float32(6000.0))
    state = battery.begin(params, slow, jnp.float32(9500.0))
    for rpm in (6500.0, 5000.0, 8000.0):  # not the commanded speed
        state = battery.update(params, state, Rotors.same(jnp.float32(rpm)), slow)
    assert float(state.highest) == 9500.0
