"""The network in fixed point: Python's own integers, the error bound, the proof, refusals."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.assembly import race_of
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export import emulator
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.emulator import fixed_point_actor, fixed_point_fly
from quadjax.export.integers import ONE
from quadjax.export.network import LARGEST_HIDDEN, convert
from quadjax.export.proof import error_bound, prove
from quadjax.export.ranges import declare, parse_overrides
from quadjax.export.report import float64_commands
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.layout import Layout, Observation, ObservedField
from quadjax.race.observations import make_layout
from quadjax.vehicle.motor import MODEL
from tests.export.support import made_policy, named_network, observations, own_race


def by_hand(network, x):
    """One inference in Python's integers, word for word what the format says."""
    y = []
    for value, exponent in zip(x.tolist(), network.box.exponents, strict=True):
        limit = 2.0**exponent
        value = 0.0 if value != value else min(max(value, -limit), limit)
        y.append(int(value * 2.0 ** (30 - exponent)))
    for layer in network.layers:
        rows = zip(layer.weights.tolist(), layer.bias.tolist(), strict=True)
        sums = [b + sum(w * v for w, v in zip(row, y, strict=True)) for row, b in rows]
        assert all(-(2**63) <= s < 2**63 for s in sums)
        y = [max(0, s >> 32) for s in sums]
    ends = zip(sums, network.command_low.tolist(), network.command_high.tolist(), strict=True)
    return [min(max(s >> network.output_shift, low), high) for s, low, high in ends]


@pytest.mark.parametrize("name", ["motor 64", "rate", "narrow", "linear"])
def test_numpy_is_the_format_by_hand(name):
    _, network = named_network(name)
    x = observations(network, 40)
    assert emulator.forward(network, x).tolist() == [by_hand(network, row) for row in x]


@pytest.mark.parametrize("name", ["odd", "rate", "linear"])
def test_jax_is_numpy_bit_for_bit(name):
    _, network = named_network(name)
    x = np.concatenate([check_vectors(network, 4000, None), hostile_vectors(network)])
    with jax.enable_x64(True):
        found = jax.jit(functools.partial(emulator.forward, network, xp=jnp))(x)
    assert found.dtype == np.int32
    assert np.array_equal(np.asarray(found), emulator.forward(network, x))


def test_actors_give_the_same_command():
    policy, network = named_network("motor 64")
    x = check_vectors(network, 64, None)
    wanted = emulator.commands(network, x)
    for double in (False, True):  # whatever the flag
        with jax.enable_x64(double):
            commands = np.asarray(jax.jit(jax.vmap(fixed_point_actor(policy)))(x))
        assert np.abs(commands - wanted).max() < 1e-3
    own, act = own_race(policy).pilot, fixed_point_fly(policy)
    action = np.asarray(jax.vmap(lambda o: act(own, o, np.zeros(4)))(x))
    assert np.abs(3000.0 + 4000.0 * (action + 1.0) - wanted).max() < 2e-3


@pytest.mark.slow
def test_the_fixed_point_policy_flies_the_laps_of_the_float_one():
    config, policy = load_config("e2e +residual"), Policy.load(PRETRAINED / "e2e.npz")
    fly = functools.partial(
        pilot.fly_policy, *race_of(config), policy, laps=1, runs=1, deterministic=True
    )
    (wanted, _), (found, _) = fly(), fly(actor=fixed_point_fly(policy))
    assert found.finished == wanted.finished == 1
    assert found.totals[0] == pytest.approx(wanted.totals[0], abs=0.011)


@pytest.mark.parametrize("name", ["motor 64", "rate", "linear"])
def test_error_is_within_the_proven_bound(name):
    policy, network = named_network(name)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (3000, network.inputs)) * rng.choice([0.1, 1], (3000, 1))
    x = (x * network.box.ranges).astype(np.float32)
    error = np.abs(emulator.commands(network, x) - float64_commands(policy, x)).max(axis=0)
    assert np.all(error <= prove(network, policy).error_bound)
    assert np.all(error <= 0.5 if policy.vehicle == "motor" else error <= 6e-4)


def test_the_bound_holds_for_the_largest_error_that_a_search_finds():
    policy, network = named_network("narrow")
    rng = np.random.default_rng(0)
    layers = [
        dataclasses.replace(layer, weights=layer.weights >> 16 << 16)  # as if of 16 bits
        for layer in network.layers
    ]
    rough = dataclasses.replace(network, hidden=tuple(layers[:-1]), output=layers[-1])
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
    policy, network = named_network("motor 64")
    proof, first = prove(network, policy), network.layers[0]
    for row in range(8):  # its worst corner
        corner = np.where(first.weights[row] > 0, ONE, -ONE)[None]
        _, trace = emulator.forward_traced(network, corner)
        assert int(trace[0][0, row]) == proof.layers[0].high[row]
    signs = np.array(list(itertools.product((-1, 1), repeat=8)))
    _, trace = emulator.forward_traced(network, np.tile(signs, (1, 3)) * ONE)
    assert max(int((sums >> 32).max()) for sums in trace[:-1]) <= LARGEST_HIDDEN


def test_a_neuron_that_is_never_active_costs_nothing():
    policy = made_policy(8)
    policy.layers[0][1][3] = -1e9
    network = convert(policy)
    assert [high >> 32 for high in prove(network, policy).layers[0].high].count(0) == 1
    assert not network.hidden[0].weights[3].any()


def corrupted(layer, row):
    policy, network = named_network("rate")
    layers = list(network.layers)
    weights, bias = layers[layer].weights.copy(), layers[layer].bias.copy()
    weights[row], bias[row] = 2**31 - 1, 2**62 + 2**61
    layers[layer] = dataclasses.replace(layers[layer], weights=weights, bias=bias)
    prove(dataclasses.replace(network, hidden=tuple(layers[:-1]), output=layers[-1]), policy)


def weighted(layer, place, value):
    policy = made_policy(8)
    policy.layers[layer][0][place] = np.float32(value)
    convert(policy)


def changed(**fields):
    convert(dataclasses.replace(made_policy(8), **fields))


def observing(*fields):
    declare(dataclasses.replace(made_policy(8), layout=Layout((*MADE.layout.fields, *fields))))


def flown(velocity):
    x = np.zeros((3, 24), np.float32)
    x[1, 4] = velocity
    declare(MADE).check(x)


MADE = made_policy(8)
REFUSED = {  # what is refused, by its message
    "layer 0, row 2": lambda: corrupted(0, 2),
    "layer 1, row 5": lambda: corrupted(1, 5),
    "layer 3, row 1": lambda: corrupted(3, 1),
    "layer 1, row 6: nan": lambda: weighted(1, (2, 6), np.nan),
    "layer 1, row 6: inf": lambda: weighted(1, (2, 6), np.inf),
    "layer 3, row 2.*range proof fails": lambda: weighted(3, (slice(None), 2), 1e30),
    "layer 0, row 0.*unsupported": lambda: changed(activation="tanh"),
    "vehicle model 'own' has no C": lambda: changed(vehicle="own"),
    "65535": lambda: changed(command_high=np.full(4, 70000.0)),
    "observes 'wind' .2 numbers., which has no C": lambda: observing(
        ObservedField("wind", 2, "m/s", "body")
    ),
    r"reaches 20 m/s, declared \+-16.*velocity=32": lambda: flown(20.0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_converted_is_refused(message):
    with pytest.raises(InputError, match=message):
        REFUSED[message]()


def test_ranges_are_declared():
    assert declare(MADE, parse_overrides(["velocity=32", "position=8"])).ranges[4] == 32.0
    layout = make_layout(MODEL, Observation(wrap_next_yaw=False))
    assert declare(dataclasses.replace(MADE, layout=layout)).ranges[19] == 8.0
    flown(16.0)
