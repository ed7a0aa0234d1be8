"""The emulators against Python's own integers and against each other."""

import functools

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.export import emulator
from quadjax.export.actor import fixed_point_actor, fixed_point_fly, fixed_point_forward
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.proof import prove
from quadjax.export.race_source import own_race
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from tests.export.support import POLICIES, named_network, observations
from tests.test_training import ROOT


def by_hand(network, x):
    """One inference in Python's integers, word for word what the format says."""
    y = []
    for value, exponent in zip(x.tolist(), network.box.exponents, strict=True):
        limit = 2.0**exponent
        value = 0.0 if value != value else min(max(value, -limit), limit)
        y.append(int(value * 2.0 ** (30 - exponent)))
    for layer in network.hidden:
        sums = [
            b + sum(w * v for w, v in zip(row, y, strict=True))
            for row, b in zip(layer.weights.tolist(), layer.bias.tolist(), strict=True)
        ]
        assert all(-(2**63) <= s < 2**63 for s in sums)
        y = [max(0, s >> 32) for s in sums]
    commands = []
    rows = zip(network.output.weights.tolist(), network.output.bias.tolist(), strict=True)
    for i, (row, b) in enumerate(rows):
        total = b + sum(w * v for w, v in zip(row, y, strict=True))
        shifted = total >> network.output_shift
        commands.append(
            min(max(shifted, int(network.command_low[i])), int(network.command_high[i]))
        )
    return commands


@pytest.mark.parametrize("name", ["motor 64", "rate", "narrow", "linear"])
def test_numpy_is_the_format_by_hand(name):
    _, network = named_network(name)
    x = observations(network, 40)
    found = emulator.forward(network, x)
    assert found.tolist() == [by_hand(network, row) for row in x]


FEW = ["odd", "rate"]
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in POLICIES if name not in FEW]


@pytest.mark.parametrize("name", [*FEW, *SLOW])
def test_jax_is_numpy_bit_for_bit(name):
    policy, network = named_network(name)
    prove(network, policy)
    x = np.concatenate([check_vectors(network, 4000, None), hostile_vectors(network)])
    found = jax.jit(jax.vmap(fixed_point_forward(network)))(x)
    assert found.dtype == np.int32
    assert np.array_equal(np.asarray(found), emulator.forward(network, x))


def test_jax_does_not_depend_on_the_x64_flag():
    _, network = named_network("rate")
    x = check_vectors(network, 500, None)
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(jax.vmap(fixed_point_forward(network)))(x))
    assert np.array_equal(found, emulator.forward(network, x))


def test_actors_give_the_same_command():
    policy, network = named_network("motor 64")
    x = check_vectors(network, 64, None)
    wanted = emulator.commands(network, x)
    commands = np.asarray(jax.vmap(fixed_point_actor(policy))(x))
    assert np.abs(commands - wanted).max() < 1e-3
    config, origin = race_of_policy(policy)
    own = own_race(config, policy, origin).pilot
    act = fixed_point_fly(policy)
    action = np.asarray(jax.vmap(lambda o: act(own, o, np.zeros(4)))(x))
    assert np.abs(3000.0 + 4000.0 * (action + 1.0) - wanted).max() < 2e-3


@pytest.mark.slow
def test_the_fixed_point_policy_flies_the_laps_of_the_float_one():
    config = load_config("e2e +residual")
    policy = Policy.load(ROOT / "quadjax" / "pretrained" / "e2e.npz")
    fly = functools.partial(
        pilot.fly_policy, *race_of(config), policy, laps=1, runs=1, deterministic=True
    )
    wanted, _ = fly()
    found, _ = fly(actor=fixed_point_fly(policy))
    assert found.finished == wanted.finished == 1
    assert found.totals[0] == pytest.approx(wanted.totals[0], abs=0.011)


def test_status_masks():
    _, network = named_network("motor 64")
    x = np.zeros((4, 24), np.float32)
    x[0, 3], x[1, 5], x[2, 0], x[3, 23] = np.nan, np.inf, 8.0, -2.0000002
    q, clipped, nan = emulator.quantize(network, x)
    assert nan.tolist() == [8, 0, 0, 0]
    assert clipped.tolist() == [0, 32, 0, 1 << 23]
    assert q[1, 5] == 2**30 and q[2, 0] == 2**30 and q[3, 23] == -(2**30) and q[0, 3] == 0
