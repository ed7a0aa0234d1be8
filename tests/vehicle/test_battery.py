"""The onboard estimate of the highest speed that a battery permits, and a battery in the race."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.vectors import Rotors
from quadjax.race.observations import HIGHEST_RPM
from quadjax.vehicle import battery
from tests.race.support import compiled_observe, compiled_reset, compiled_transition, hover_state

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


@pytest.mark.parametrize(
    ("first", "top", "last"),
    [
        *((first, 9700.0, 9700.0) for first in (9000.0, 9700.0, 11000.0)),
        (9000.0, 20000.0, HIGHEST),  # of a full battery
    ],
)
def test_it_finds_the_limit_from_any_first_estimate(first, top, last):
    estimates = _estimated(first, top, 4000.0)
    assert estimates[-1] == pytest.approx(last, rel=2e-3) and estimates.max() <= HIGHEST
    if first == last:  # it stays exact while speeds change
        np.testing.assert_allclose(estimates, last, rtol=1e-4)


def test_the_estimate_has_a_lowest_value():
    assert _estimated(9000.0, 3000.0, 3000.0).min() >= battery.LOWEST * HIGHEST


def test_commands_below_the_limit_change_nothing():
    params = battery.limit_estimator(HIGHEST, LAG, 1.0 / STEP)
    slow = Rotors.same(jnp.float32(6000.0))
    state = battery.begin(params, slow, jnp.float32(9500.0))
    for rpm in (6500.0, 5000.0, 8000.0):  # not the commanded speed
        state = battery.update(params, state, Rotors.same(jnp.float32(rpm)), slow)
    assert float(state.highest) == 9500.0


LOW, HIGH = 0.2, 0.6


def _race(*overrides):
    return make_race(load_config("e2e", [f"battery.charge=[{LOW}, {HIGH}]", *overrides]))


def _limit(rpm: np.ndarray, charge: float) -> float:
    """The highest speed, rpm, of the Bebop's battery, in float64."""
    load = np.mean((rpm / np.sqrt(9.81 / (4.0 * 4.36e-8))) ** 3)
    volts = 12.6 - 1.5 * (1.0 - charge) - 0.07 * 6.5 * load
    return 12000.0 * volts / 12.6


@pytest.mark.slow
def test_full_power_reaches_the_limit_and_the_policy_observes_it():
    """The estimate and the true limit, which agree after a flight at full power."""
    races = [_race(f"observation.highest_rpm={source}") for source in ("estimated", "ground_truth")]
    environment, params = races[0]
    state = jax.tree.map(lambda leaf: leaf[None], hover_state(races[0]))
    before = state.battery.charge[0]
    assert before == pytest.approx(HIGH)
    for _ in range(70):
        state, *_ = compiled_transition(environment)(params, state, np.ones((1, 4), np.float32))
    rpm = np.array(jax.tree.leaves(state.drone.actuators), np.float64)[:, 0]
    limit = _limit(rpm, float(state.battery.charge[0]))
    np.testing.assert_allclose(rpm, limit, rtol=1e-3)
    assert before - 0.01 < state.battery.charge[0] < before
    lowest, highest = 0.75 * 11000.0, 11000.0
    for environment, params in races:
        (seen,) = compiled_observe(environment)(params, state)[
            0, environment.layout.slice(HIGHEST_RPM)
        ]
        assert lowest + 0.5 * (highest - lowest) * (seen + 1.0) == pytest.approx(limit, rel=5e-3)


def test_charges_are_drawn_from_the_range():
    environment, params = _race()
    charge = compiled_reset(environment)(params, jax.random.key(0), 500).battery.charge
    assert charge.min() == pytest.approx(LOW, abs=0.01)
    assert charge.max() == pytest.approx(HIGH, abs=0.01)
    assert charge.mean() == pytest.approx(0.5 * (LOW + HIGH), abs=0.02)
