"""A battery in the race: charges, limited speeds, and what the policy observes."""

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.race.observations import HIGHEST_RPM
from tests.race.support import compiled_observe, compiled_reset, compiled_transition, hover_state

LOW, HIGH = 0.2, 0.6


def _race(*overrides):
    return race_of(load_config("e2e", [f"battery.charge=[{LOW}, {HIGH}]", *overrides]))


def _limit(rpm: np.ndarray, charge: float) -> float:
    """The highest speed, rpm, of the Bebop's battery, in float64."""
    load = np.mean((rpm / np.sqrt(9.81 / (4.0 * 4.36e-8))) ** 3)
    volts = 12.6 - 1.5 * (1.0 - charge) - 0.07 * 6.5 * load
    return 12000.0 * volts / 12.6


def test_full_power_reaches_the_limit_and_the_policy_observes_it():
    """The estimate and the true limit, which agree after a flight at full power."""
    races = [_race(f"observation.highest_rpm={source}") for source in ("estimated", "ground_truth")]
    choices, params = races[0]
    state = jax.tree.map(lambda leaf: leaf[None], hover_state(races[0]))
    before = state.battery.charge[0]
    assert before == pytest.approx(HIGH)
    for _ in range(70):
        state, *_ = compiled_transition(choices)(params, state, np.ones((1, 4), np.float32))
    rpm = np.array(jax.tree.leaves(state.drone.actuators), np.float64)[:, 0]
    limit = _limit(rpm, float(state.battery.charge[0]))
    np.testing.assert_allclose(rpm, limit, rtol=1e-3)
    assert before - 0.01 < state.battery.charge[0] < before
    lowest, highest = 0.75 * 11000.0, 11000.0
    for choices, params in races:
        (seen,) = compiled_observe(choices)(params, state)[0, choices.layout.slice(HIGHEST_RPM)]
        assert lowest + 0.5 * (highest - lowest) * (seen + 1.0) == pytest.approx(limit, rel=5e-3)


def test_charges_are_drawn_from_the_range():
    choices, params = _race()
    charge = compiled_reset(choices)(params, jax.random.key(0), 500).battery.charge
    assert charge.min() == pytest.approx(LOW, abs=0.01)
    assert charge.max() == pytest.approx(HIGH, abs=0.01)
    assert charge.mean() == pytest.approx(0.5 * (LOW + HIGH), abs=0.02)
