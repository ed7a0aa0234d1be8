"""Motors, battery and gusts of a plant, each as its source says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import periodogram

from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import effects, gusts
from quadjax.plant.config import GustsConfig
from quadjax.plant.plant import build_plant
from quadjax.vehicle import battery
from tests import reference as ref
from tests.plant import effects_reference as source
from tests.plant.support import OFF, only


def test_motors_answer_in_second_order():
    config = only(motors=1.0).motors
    hover, tau, lag, short = jnp.float32(7497.0), 0.06, config.lag, config.shortfall
    dt, count = 1e-4, 3000

    def one(carry, _):
        w, rate = carry
        u = Rotors.same(jnp.float32(8000.0))
        target = effects.steady_speeds(u, jnp.float32(short), hover, jnp.inf)
        a, b = effects.rotor_rates(jnp.float32(tau), 1.0, jnp.float32(lag), w, rate, target)
        following = (w + a * dt, rate + b * dt)
        return following, following[0].w1

    start = (Rotors.same(jnp.float32(7000.0)), Rotors.same(jnp.float32(0.0)))
    flown = np.asarray(jax.jit(lambda: jax.lax.scan(one, start, None, count)[1])())
    end = 8000.0 - short * (8000.0 - 7497.0)
    time = dt * np.arange(1, count + 1)
    expected = 7000.0 + (end - 7000.0) * source.second_order(tau, lag, time)
    assert np.abs(flown - expected).max() < 3.0
    first = 7000.0 + (8000.0 - 7000.0) * (1.0 - np.exp(-time / tau))
    early = time < 0.01
    assert np.all(flown[early] < first[early])  # later than the model, and never quite there
    assert short > 0 and flown[-1] < 8000.0 - 5.0


def test_motors_that_brake_less_than_they_drive_are_slower_in_slowing_down():
    at, still = Rotors(*np.float32([7000, 7000, 7000, 7000])), Rotors.same(np.float32(0.0))
    target = Rotors(*np.float32([8000, 6000, 7000, 5000]))
    rates, _ = effects.rotor_rates(0.05, 2.0, np.float32(0.0), at, still, target)
    np.testing.assert_allclose(rates.array(), [20000, -10000, 0, -20000], rtol=1e-6)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0, 1.25])
def test_a_command_arrives_after_its_delay(delay):
    """Between two samples it is on the line between the two commands."""
    past = np.float32([500.0, 900.0, 700.0, 400.0])  # the oldest first
    found = effects.delayed([Rotors.same(u) for u in past], jnp.float32(delay))
    assert float(found.w3) == pytest.approx(np.interp(3.0 - delay, range(4), past))


def test_the_battery_lowers_what_can_be_reached():
    config = only(battery=1.0)
    p, b = build_plant(config).battery, config.battery
    rpm = Rotors.same(jnp.float32(9000.0))
    found = float(battery.highest_rpm(p, rpm, jnp.float32(0.7)))
    current = b.hover_current * (9000.0 / np.sqrt(9.81 / (4.0 * ref.MOTOR["k_w"]))) ** 3
    volts = b.voltage - b.drop * 0.3 - b.resistance * current
    assert found == pytest.approx(12000.0 * volts / b.voltage, rel=1e-5)
    rate = float(battery.charge_rate(p, rpm))
    assert rate == pytest.approx(-current / 3600 / b.capacity, rel=1e-5)
    none = build_plant(OFF).battery
    assert np.isinf(float(battery.highest_rpm(none, rpm, jnp.float32(0.0))))


def test_gusts_have_drydens_spread_and_spectrum():
    wind, altitude, speed, step = 5.0, 6.1, 6.0, 0.02
    params = as_leaves(GustsConfig(wind=wind, altitude=altitude))
    feet = altitude / 0.3048
    along = 0.1 * wind / (0.177 + 0.000823 * feet) ** 0.4
    length = feet / (0.177 + 0.000823 * feet) ** 1.2 * 0.3048
    runs, count = 256, 2048
    moving = Vec3(jnp.float32(speed), jnp.float32(0.0), jnp.float32(0.0))

    @jax.jit
    def fly(key):
        start = jax.vmap(gusts.init, -1, -1)(jax.random.normal(key, (gusts.START_DRAWS, runs)))

        def one(state, key):
            drawn = jax.random.normal(key, (gusts.DRAWS, runs))
            update = jax.vmap(gusts.update, (None, -1, None, None, -1), -1)
            state = update(params, state, moving, jnp.float32(step), drawn)
            return state, gusts.velocity(params, state).array()

        return jax.lax.scan(one, start, jax.random.split(key, count))[1]

    flown = np.asarray(fly(jax.random.key(0)), np.float64)  # (time, runs, 3)
    deviations, lengths = (along, along, 0.1 * wind), (length, length, altitude)
    np.testing.assert_allclose(flown.std(axis=(0, 1)), deviations, rtol=0.08)
    hertz, density = periodogram(flown, 1.0 / step, window="hann", axis=0)
    frequency, density = 2.0 * np.pi * hertz, density / (2.0 * np.pi)
    for axis in range(3):
        for low, high in ((1.0, 2.0), (4.0, 8.0)):
            band = (frequency > low) & (frequency < high)
            expected = source.dryden_power(
                deviations[axis], lengths[axis], speed, frequency[band], axis == 0
            )
            found = density[band, :, axis].mean()
            assert found == pytest.approx(expected.mean(), rel=0.12)
