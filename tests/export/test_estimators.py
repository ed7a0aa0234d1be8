"""The estimators on board next to those of ``quadjax.vehicle`` in float64, and in flight."""

import dataclasses

import jax
import numpy as np
import pytest

from quadjax.export import emulator, motions
from quadjax.export.network import convert as fixed_network
from quadjax.export.race_source import policy_race
from quadjax.sil.autopilot import ExportedC
from quadjax.sil.run import make_drone
from quadjax.vehicle.battery import middle_limit
from tests.export.support import convert, converted, library, made


@pytest.mark.parametrize("rate, cutoff", [(512.0, 8.0), (400.0, 16.0)])
def test_moment_and_force_are_the_reference_in_float64(rate, cutoff, tmp_path):
    """With residual networks and a residual of the thrust that is subtracted."""
    of = converted("everything", tmp_path, sample_rate=rate, cutoff=cutoff)
    assert of.in_c.disturbance.residual is not None
    log = motions.tumbling(np.random.default_rng(0), rate, 4.0)
    exact = motions.estimate_float64(of.race.params.vehicle, log, rate, cutoff)
    error = np.abs(library(of, tmp_path / "c").disturbances(log) - exact)
    assert error[:, :3].max() < 1e-5 and error[:, 3:].max() < 2e-4
    assert np.ptp(exact, axis=0).min() > 1e-2


@pytest.mark.parametrize("rate", [100.0, 512.0])
def test_the_highest_speed_is_the_reference_in_float64(rate, tmp_path):
    of = converted("battery", tmp_path, sample_rate=rate)
    constants = of.race.params.vehicle.constants
    seconds = min(8.0, 8_000 / rate)
    log = motions.full_power_bursts(np.random.default_rng(0), constants, rate, seconds)
    found = library(of, tmp_path / "c").highest_rpm(log)
    exact = motions.highest_float64(constants, of.in_c.battery.first, log, rate)
    assert np.abs(found - exact).max() < 0.05
    assert np.ptp(found) > 100.0


def reacting():
    """A policy that commands much, and reacts to the highest rpm; and its race."""
    policy, own = made("battery")
    (first, bias), (last, _) = policy.layers
    first = np.concatenate([0.6 * first[:-1], np.linspace(-2.0, 2.0, 8)[None]]).astype(np.float32)
    layers = ((first, bias + np.float32(0.5)), (last, np.float32([1.1, 1.0, 0.9, 1.0])))
    policy = dataclasses.replace(policy, layers=layers)
    return policy, policy_race(own.config, policy, "test")


def begun(drone):
    """A start with the first estimate of the C, which is that of the middle of the charges."""
    now, first = drone.begin(0), middle_limit(drone.params.battery)
    race = now.state.state
    estimate = race.battery.estimate.replace(highest=first[None])
    race = race.replace(battery=race.battery.replace(estimate=estimate))
    return dataclasses.replace(now, state=now.state.replace(state=race))


@pytest.mark.slow
def test_the_c_on_board_observes_what_the_simulator_does(tmp_path):
    """Commands of the C, and of the policy with the simulator's estimate, step by step."""
    policy, own = reacting()
    of = convert(policy, own, tmp_path, sample_rate=100.0)
    drone = make_drone(own.config, policy, None, 1)
    c = ExportedC(of, tmp_path / "c", 100.0)
    observe = jax.jit(drone.environment.observation)
    network = fixed_network(policy, {"position": 32.0})
    now, held, apart, limits = begun(drone), np.full(4, 7000.0), [], []
    for number in range(150):
        now.vehicle["time_us"] = now.vehicle["position_us"] = 10_000 * number
        now.vehicle["autopilot_command"] = held
        _, sent = c.step(10_000 * number, now.vehicle)
        race = jax.tree.map(lambda x: x[..., 0], now.state.state)
        limits.append(float(race.battery.estimate.highest))
        seen = np.asarray(observe(drone.params, race))[None]
        apart.append(np.abs(sent - emulator.commands(network, seen)[0]).max())
        if now.over:
            break
        held, now = sent, drone.advance(now, sent)
    assert np.ptp(limits) > 20.0
    assert max(apart) < 1.0  # the C rounds to whole rpm
