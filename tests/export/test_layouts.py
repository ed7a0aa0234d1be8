"""The C of every choice of the observation: the inputs of the environment, and its verification."""

import dataclasses
import functools

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.export import emulator, flights
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.convert import export_c
from quadjax.export.race_source import own_race
from quadjax.export.states import observe
from quadjax.export.verify import run
from quadjax.export.verify.result import FAILED, PASSED
from tests.export.support import fixed_policy, library, random_states, untrained

MORE = ("observation.gates_ahead=2", "observation.last_action=true")
AXES = "observation.attitude=rotation"
FIVE_INCH = ("vehicle=5inch", "observation.actuator_range=[0, 3000]")
HISTORY = (
    "observation.history={fields: [position, %s, rates, %s, last_action], steps: 2, every: %d}"
)
RACES = {  # preset, overrides, size of the observation
    "e2e with a history": ("e2e +disturbance", (HISTORY % ("velocity, attitude", "rpm", 9),), 64),
    "racing, axes and more": ("e2e", (*FIVE_INCH, AXES, *MORE), 31),
    "e2e, axes and more": ("e2e +disturbance", (AXES, *MORE, "battery.charge=[0.1, 1.0]"), 36),
    "e2e with quaternions": ("e2e +disturbance", ("vehicle.quaternion=true",), 24),
    "indi and more": ("indi", ("observation.gates_ahead=3", MORE[1]), 29),
    "racing with a history": (
        "e2e",
        (*FIVE_INCH, AXES, MORE[1], HISTORY % ("rotation", "rotor_speed", 2)),
        27 + 40,
    ),
    "published racing": ("e2e", FIVE_INCH, 20),
}
EVERY_FIELD = list(RACES)[:5]  # each kind of field once
FEW = [pytest.param(name, marks=pytest.mark.slow) for name in EVERY_FIELD[2:]]


@functools.cache
def made(name):
    """An untrained policy of a race, and the race."""
    preset, overrides, size = RACES[name]
    config = load_config(preset, [*overrides, "network.hidden=[8]", "track.generate.seed=1"])
    policy = untrained(config)
    assert policy.layout.size == size
    layers = [(np.asarray(k) * 0.3, np.asarray(b) + 0.01) for k, b in policy.layers]
    return dataclasses.replace(policy, layers=tuple(layers)), own_race(config, policy, "test")


def converted_in(folder, policy, own, target, rate=500.0):
    """A policy converted, with its C in a folder, without the simulated flights of an export."""
    folder.mkdir(exist_ok=True)
    policy.save(folder / "policy.npz")
    rng = np.random.default_rng(0)
    states = random_states(rng, 20, own, policy.command_low, policy.command_high)
    targets = np.arange(20) % len(own.params.track.yaw)
    rows = flights.Rollouts(observe(own, states, targets), states, targets)
    options = Options("made", {"position": 32.0}, sample_rate=rate, target=target)
    path = folder / "policy.npz"
    converted = convert_policy(policy, own, options, path.name, path, rows)
    for name, data in converted.files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return converted


@functools.cache
def fixed(name):
    """Race, policy as integers, and 200 states and targets."""
    policy, own = made(name)
    rng = np.random.default_rng(0)
    states = random_states(rng, 200, own, policy.command_low, policy.command_high)
    targets = rng.integers(0, len(own.params.track.yaw), 200)
    return own, fixed_policy(policy, own, states, targets), states, targets


@pytest.mark.parametrize("name", [*EVERY_FIELD[:2], *FEW])
def test_the_inputs_of_the_c_are_those_of_the_environment(name, tmp_path):
    own, policy, states, targets = fixed(name)
    network = policy.network
    q, status = emulator.observe(policy.race, states, targets)
    assert not status.any()
    found = q / 2.0**30 * network.box.ranges
    error = np.abs(found - observe(own, states, targets))
    assert error.max() < 2e-5 and np.abs(found).max(axis=0).min() > 0
    rows = library(policy, tmp_path).observe(states, targets)
    np.testing.assert_array_equal(rows[:, :-3], q)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY_FIELD)
def test_an_exported_folder_passes_its_verification(name, tmp_path):
    policy, _ = made(name)
    policy.save(tmp_path / "policy.npz")
    wide = {"position": 64.0, "velocity": 128.0, "rates": 1024.0, "attitude": 4.0}
    ranges = {key: value for key, value in wide.items() if key in policy.layout}
    out = tmp_path / "c"
    export_c(tmp_path / "policy.npz", out, ranges=ranges, name="made", allow_unfinished=True)
    assert (out / "paparazzi").exists() == (policy.vehicle != "racing")
    only = ("range proof", "NumPy = C", "simulator", "processor", "estimators")
    results = {r.check: r for r in run.verify(out, 1000, only=only)}
    assert all(r.verdict != FAILED for r in results.values()), results
    assert all(results[name].verdict == PASSED for name in only[:3])
