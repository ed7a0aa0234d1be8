"""The network in fixed point: four implementations of it, its error bound and its proof."""

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.export import emulator
from quadjax.export.emulator import fixed_point_actor, fixed_point_fly
from quadjax.export.integers import ONE, quantize
from quadjax.export.network import LARGEST_HIDDEN, convert
from quadjax.export.proof import error_bound, prove
from quadjax.export.ranges import declare
from quadjax.export.report import float64_commands
from quadjax.export.vectors import check_vectors, hostile_vectors
from quadjax.race.observation_config import Observation
from quadjax.race.observations import make_layout
from quadjax.vehicle.motor import MODEL
from tests.export import support
from tests.export.support import library, made, observations

NETWORKS = {  # race, hidden layers
    "motor 64": ("e2e", (64, 64, 64)),
    "rate": ("indi", (16, 16, 16)),
    "narrow": ("e2e", (5,)),
    "no hidden layer": ("e2e", ()),
    "sizes that no block divides": ("e2e", (33, 7, 18)),
    "mixed": ("e2e", (96, 96, 48)),
}
FEW = ("narrow", "no hidden layer", "sizes that no block divides")
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in NETWORKS if name not in FEW]


def converted(name):
    """One of ``NETWORKS`` with weights of the usual size, and as integers."""
    policy, _ = made(*NETWORKS[name], 1.0)
    return policy, convert(policy)


def by_hand(network, x):
    """One inference in Python's integers, word for word what the format says."""
    y = []
    for value, exponent in zip(x.tolist(), network.box.exponents, strict=True):
        limit = 2.0**exponent
        value = min(max(value, -limit), limit) if math.isfinite(value) else 0.0
        y.append(int(value * 2.0 ** (30 - exponent)))
    for layer in network.layers:
        rows = zip(layer.weights.tolist(), layer.bias.tolist(), strict=True)
        sums = [b + sum(w * v for w, v in zip(row, y, strict=True)) for row, b in rows]
        assert all(-(2**63) <= s < 2**63 for s in sums)
        y = [max(0, s >> 32) for s in sums]
    ends = zip(sums, network.command_low.tolist(), network.command_high.tolist(), strict=True)
    return [min(max(s >> network.output_shift, low), high) for s, low, high in ends]


@pytest.mark.parametrize("name", [*FEW, *SLOW])
def test_python_numpy_jax_and_c_have_the_same_bits(name, tmp_path):
    in_c = support.converted(NETWORKS[name][0], tmp_path, NETWORKS[name][1], 1.0)
    network, rng = in_c.in_c.network, np.random.default_rng(0)
    x = observations(network, 40)
    assert emulator.forward(network, x).tolist() == [by_hand(network, row) for row in x]
    x = np.concatenate([check_vectors(network, 800, None), hostile_vectors(network)])
    with jax.enable_x64(True):
        found = jax.jit(functools.partial(emulator.forward, network, xp=jnp))(x)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, emulator.forward(network, x))
    q = quantize(x, network.box.exponents).astype(np.int32)
    q = np.concatenate([q, rng.integers(-(2**31), 2**31, q[:50].shape)])
    c = library(in_c, tmp_path / "c")
    np.testing.assert_array_equal(c.forward(q), emulator.forward_rows(network, q))
    np.testing.assert_array_equal(c.quantize(x), quantize(x, network.box.exponents))
    whole = network.model.commands[0].name == "rpm"  # motor controllers take whole rpm
    wanted = emulator.forward_rows(network, q)[:, :4] / 2.0**network.fraction_bits
    wanted = np.floor(wanted + 0.5) if whole else wanted
    np.testing.assert_array_equal(c.act(q), wanted.astype(np.float32))


def test_actors_give_the_same_command():
    policy, own = made("e2e", (64, 64, 64))
    network = convert(policy)
    x = check_vectors(network, 64, None)
    wanted = emulator.commands(network, x)
    for double in (False, True):  # whatever the flag
        with jax.enable_x64(double):
            commands = np.asarray(jax.jit(jax.vmap(fixed_point_actor(policy)))(x))
        assert np.abs(commands - wanted).max() < 1e-3
    act = fixed_point_fly(policy)
    action = np.asarray(jax.vmap(lambda o: act(own.pilot, o, np.zeros(4)))(x))
    assert np.abs(3000.0 + 4000.0 * (action + 1.0) - wanted).max() < 2e-3


@pytest.mark.parametrize("name", ["motor 64", "rate", "no hidden layer"])
def test_the_error_is_within_the_proven_bound(name):
    policy, network = converted(name)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (3000, network.inputs)) * rng.choice([0.1, 1], (3000, 1))
    x = (x * network.box.ranges).astype(np.float32)
    error = np.abs(emulator.commands(network, x) - float64_commands(policy, x)).max(axis=0)
    assert np.all(error <= prove(network, policy).error_bound)
    assert np.all(error <= 0.5 if policy.vehicle == "motor" else error <= 6e-4)


def test_the_bound_holds_for_the_largest_error_that_a_search_finds():
    policy, network = converted("narrow")
    rng = np.random.default_rng(0)
    layers = [
        dataclasses.replace(layer, weights=layer.weights >> 16 << 16)  # as if of 16 bits
        for layer in network.layers
    ]
    rough = dataclasses.replace(network, layers=tuple(layers))
    bound = error_bound(rough, policy).max()

    def error(x):
        x = x.astype(np.float32)
        return np.abs(emulator.commands(rough, x) - float64_commands(policy, x)).max(axis=1)

    x = rng.choice([-1.0, 1.0], (2000, network.inputs)) * network.box.ranges
    best = x[error(x).argmax()]
    for _ in range(2):
        for i in range(network.inputs):
            tried = np.tile(best, (9, 1))
            tried[:, i] = np.linspace(-1.0, 1.0, 9) * network.box.ranges[i]
            best = tried[error(tried).argmax()]
    assert 0.005 * bound < error(best[None])[0] <= bound


def test_proven_ranges_hold_at_corners_and_are_reached():
    policy, network = converted("motor 64")
    proof, first = prove(network, policy), network.layers[0]
    for row in range(8):  # its worst corner
        corner = np.where(first.weights[row] > 0, ONE, -ONE)[None]
        _, trace = emulator.forward_traced(network, corner)
        assert int(trace[0][0, row]) == proof.layers[0].high[row]
    signs = np.array(list(itertools.product((-1, 1), repeat=8)))
    _, trace = emulator.forward_traced(network, np.tile(signs, (1, 3)) * ONE)
    assert max(int((sums >> 32).max()) for sums in trace[:-1]) <= LARGEST_HIDDEN


def test_a_neuron_that_is_never_active_costs_nothing():
    """No bit of precision either: the error is bounded as without it."""
    policy, _ = made("e2e")
    (kernel, bias), (last, last_bias) = policy.layers
    neurons = np.arange(8)
    silent = np.where(neurons == 3, np.float32(-1e9), bias)
    policy = dataclasses.replace(policy, layers=((kernel, silent), (last, last_bias)))
    network = convert(policy)
    proof = prove(network, policy)
    assert [high >> 32 for high in proof.layers[0].high].count(0) == 1
    assert not network.layers[0].weights[3].any()
    used = neurons != 3
    layers = (kernel[:, used], bias[used]), (last[used], last_bias)
    without = dataclasses.replace(policy, layers=layers)
    expected = prove(convert(without), without).error_bound
    np.testing.assert_allclose(proof.error_bound, expected, rtol=0.05)


def test_ranges_are_declared():
    policy, _ = made("e2e")
    assert declare(policy, {"velocity": 32.0, "position": 8.0}).ranges[4] == 32.0
    layout = make_layout(MODEL, Observation(wrap_next_yaw=False))
    assert declare(dataclasses.replace(policy, layout=layout)).ranges[19] == 8.0
