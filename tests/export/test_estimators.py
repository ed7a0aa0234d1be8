"""The estimators on board: of the disturbance, and of the highest propeller speed of a battery."""

import dataclasses
from fractions import Fraction

import jax
import numpy as np
import pytest

from quadjax.export import emulator
from quadjax.export.battery import FINE_BITS, make_battery
from quadjax.export.disturbances import make_estimator
from quadjax.export.estimator_emulator import FINE, Battery, estimate, estimate_highest
from quadjax.export.integers import quantize
from quadjax.export.network import convert
from quadjax.export.race_source import policy_race
from quadjax.export.verify import measurements
from quadjax.sil.faults import RPM_PER_RAD_S
from quadjax.sil.run import make_world
from quadjax.vehicle.battery import limit_estimator, middle_limit
from quadjax.vehicle.protocol import VehicleParams
from tests import reference as ref
from tests.convert import residual_of
from tests.export.support import converted_in, fixed_policy, library, made
from tests.sil.test_exported import loaded


def constants():
    """Of the vehicle."""
    return made("battery")[1].params.vehicle.constants


@pytest.mark.parametrize("with_residual, rate, cutoff", [(True, 512.0, 8.0), (False, 400.0, 16.0)])
def test_the_disturbance_is_the_reference_in_float64(with_residual, rate, cutoff):
    residual = residual_of(ref.random_residual(-1.0)) if with_residual else None
    tables = make_estimator(constants(), residual, rate, cutoff)
    measured = measurements.tumbling(np.random.default_rng(0), rate, 4.0)
    vehicle = VehicleParams(constants(), residual)
    exact = measurements.estimate_float64(vehicle, measured, rate, cutoff)
    error = np.abs(estimate(tables, measured) - exact)
    assert error[:, :3].max() < 1e-6 and error[:, 3:].max() < 2e-5


@pytest.mark.parametrize("rate", [100.0, 512.0])
def test_the_highest_speed_is_the_reference_in_float64(rate):
    first, tables = 10300.0, make_battery(constants(), 10300.0, rate)
    seconds = min(8.0, 8_000 / rate)
    log = measurements.full_power_bursts(np.random.default_rng(0), constants(), rate, seconds)
    found = estimate_highest(tables, log)
    exact = measurements.highest_float64(constants(), first, log, rate)
    assert np.abs(found - exact).max() < 1e-3
    assert np.ptp(found) > 100.0


def random_memory(rng, tables, count):
    """Memories that the estimator can have, many of them at the edges."""
    one = 1 << FINE_BITS
    speed, expected = (
        np.where(rng.random((count, 4)) < 0.3, rng.choice([-one, one], (count, 4)), x)
        for x in rng.integers(-one, one + 1, (2, count, 4))
    )
    limited = np.where(rng.random((count, 4)) < 0.4, one, rng.integers(0, one + 1, (count, 4)))
    ends = rng.integers(tables.lowest, tables.highest + 1, count)
    highest = np.where(rng.random(count) < 0.3, tables.highest, ends)
    memory = Battery(tables, np.zeros((count, 8), np.float32))
    memory.speed, memory.expected = speed, expected
    memory.limited, memory.highest = limited, highest
    return memory


def random_samples(rng, tables, count):
    """Any numbers as speeds and commands, and any bits."""
    top = tables.highest * tables.unit
    x = (rng.uniform(-2.0, 2.0, (count, 8)) * top).astype(np.float32)
    x[:, 4:] = np.where(rng.random((count, 4)) < 0.5, np.float32(top), x[:, 4:])
    hostile = rng.random((count, 8)) < 0.1
    bits = rng.integers(0, 2**32, (count, 8), dtype=np.uint32).view(np.float32)
    return np.where(hostile, bits, x)


def exact_update(memory, q, numbers, tables, row):
    """The estimate after one sample in rational arithmetic, in fine units."""
    k, lead, gain = numbers
    limit, total = int(memory.highest[row]), Fraction(0)
    for i in range(4):
        rpm, command = (int(q[row, j]) * FINE for j in (i, i + 4))
        speed = int(memory.speed[row, i])
        expected = int(memory.expected[row, i])
        expected += k * (min(command, limit) - expected)
        limited = Fraction(int(memory.limited[row, i]), 1 << FINE_BITS)
        limited += k * ((command >= limit) - limited)
        total += (speed + lead * (rpm - speed) - expected) * limited
    return min(max(limit + gain * total, tables.lowest), tables.highest)


@pytest.mark.parametrize("rate", [512.0, 1.0, 1e5])
def test_one_sample_is_that_of_rational_numbers_from_any_memory(rate):
    rng, tables = np.random.default_rng(1), make_battery(constants(), 10000.0, rate)
    with jax.enable_x64(True):
        c = constants()
        p = limit_estimator(float(c.rpm_max), np.float64(float(c.tau)), rate)
    numbers = [Fraction(float(x)) for x in (p.low_pass, p.lead, p.gain)]
    memory, samples = random_memory(rng, tables, 400), random_samples(rng, tables, 400)
    q = quantize(samples, tables.exponents)
    exact = [exact_update(memory, q, numbers, tables, row) for row in range(400)]
    memory.update(samples)
    for part in (memory.speed, memory.expected, memory.limited - (1 << FINE_BITS - 1)):
        assert np.abs(part).max() <= 1 << FINE_BITS  # as the proof claims
    assert tables.lowest <= memory.highest.min() <= memory.highest.max() <= tables.highest
    error = max(abs(int(x) - y) for x, y in zip(memory.highest, exact, strict=True))
    assert float(error) * tables.unit < (1e-5 if rate == 512.0 else 0.002)


def test_the_c_has_the_bits_of_the_emulator(tmp_path):
    rng, tables = np.random.default_rng(2), make_battery(constants(), 10300.0, 100.0)
    c = library(fixed_policy(*made("battery"), battery=tables), tmp_path)
    bursts = measurements.full_power_bursts(rng, constants(), 100.0, 5.0)
    log = np.concatenate([bursts, random_samples(rng, tables, 500), bursts])
    for samples in (log, bursts[200:]):  # the second one after a reset
        found = c.highest_rpm(samples)
        assert np.array_equal(found, estimate_highest(tables, samples))
    assert np.ptp(found) > 50.0


def reacting():
    """A policy that commands much, and reacts to the highest rpm; and its race."""
    policy, own = made("battery")
    (first, bias), (last, _) = policy.layers
    first = np.concatenate([0.6 * first[:-1], np.linspace(-2.0, 2.0, 8)[None]]).astype(np.float32)
    layers = ((first, bias + np.float32(0.5)), (last, np.float32([1.1, 1.0, 0.9, 1.0])))
    policy = dataclasses.replace(policy, layers=layers)
    return policy, policy_race(own.config, policy, "test")


def begun(world):
    """A start with the first estimate of the C, which is that of the middle of the charges."""
    now, first = world.begin(0), middle_limit(world.params.battery)
    race = now.state.state
    estimate = race.battery.estimate.replace(highest=first[None])
    race = race.replace(battery=race.battery.replace(estimate=estimate))
    return dataclasses.replace(now, state=now.state.replace(state=race))


@pytest.mark.slow
def test_the_c_on_board_observes_what_the_simulator_does(tmp_path):
    """Commands of the C, and of the policy with the simulator's estimate, step by step."""
    policy, own = reacting()
    converted = converted_in(tmp_path, policy, own, "cortex-m7", 100.0)
    world = make_world(own.config, converted.policy, None, 1)
    c = loaded(tmp_path, converted, 100.0)
    observe = jax.jit(world.environment.observation)
    network = convert(policy, {"position": 32.0})
    now, apart, limits = begun(world), [], []
    for number in range(150):
        sent = np.float32(c.step(number / 100.0, now.vehicle) * RPM_PER_RAD_S)
        race = jax.tree.map(lambda x: x[..., 0], now.state.state)
        limits.append(float(race.battery.estimate.highest))
        seen = np.asarray(observe(world.params, race))[None]
        apart.append(np.abs(sent - emulator.commands(network, seen)[0]).max())
        if now.over:
            break
        now = world.advance(now, sent)
    assert np.ptp(limits) > 20.0
    assert max(apart) < 0.6  # the C rounds to whole rpm
