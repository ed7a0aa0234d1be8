"""A battery in the race: charges, limited speeds, and what the policy observes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.errors import InputError
from quadjax.race import environment
from quadjax.race.layout import HIGHEST_RPM

LOW, HIGH = 0.2, 0.6


def _race(*overrides):
    return race_of(load_config("e2e_shac", [f"battery.charge=[{LOW}, {HIGH}]", *overrides]))


def _limit(rpm: np.ndarray, charge: float) -> float:
    """The highest speed, rpm, of the Bebop's battery, in float64."""
    load = np.mean((rpm / np.sqrt(9.81 / (4.0 * 4.36e-8))) ** 3)
    volts = 12.6 - 1.5 * (1.0 - charge) - 0.07 * 6.5 * load
    return 12000.0 * volts / 12.6


@pytest.mark.parametrize("source", ["estimated", "ground_truth"])
def test_full_power_reaches_the_limit_and_the_policy_observes_it(source):
    choices, params = _race(f"observation.highest_rpm={source}")
    step = jax.jit(functools.partial(environment.transition, choices))
    state = environment.hover_start(choices, params)
    before = float(state.battery.charge)
    assert before == pytest.approx(HIGH)
    for _ in range(70):
        state, *_ = step(params, state, jnp.ones(4))
    rpm = np.array(jax.tree.leaves(choices.model.actuator_state(state.drone)), np.float64)
    limit = _limit(rpm, float(state.battery.charge))
    np.testing.assert_allclose(rpm, limit, rtol=1e-3)
    assert before - 0.01 < float(state.battery.charge) < before
    column = choices.layout.slice(HIGHEST_RPM)
    (seen,) = np.asarray(environment.observe(choices, params, state)[column])
    lowest, highest = 0.75 * 11000.0, 11000.0
    assert lowest + 0.5 * (highest - lowest) * (seen + 1.0) == pytest.approx(limit, rel=5e-3)


def test_charges_are_drawn_from_the_range():
    choices, params = _race()
    reset = jax.vmap(functools.partial(environment.reset, choices), (None, 0))
    charge = np.asarray(reset(params, jax.random.split(jax.random.key(0), 500)).battery.charge)
    assert charge.min() == pytest.approx(LOW, abs=0.01)
    assert charge.max() == pytest.approx(HIGH, abs=0.01)
    assert charge.mean() == pytest.approx(0.5 * (LOW + HIGH), abs=0.02)


def test_a_model_without_propeller_speeds_has_none():
    with pytest.raises(InputError, match=r"battery.charge is \[0.2, 1.0\], allowed: no battery"):
        load_config("indi", ["battery.charge=[0.2, 1.0]"])


def test_the_source_of_the_limit_has_no_effect_without_a_battery():
    with pytest.raises(InputError, match="observation.highest_rpm is 'none'.*without battery"):
        load_config("e2e_shac", ["observation.highest_rpm=none"])
