"""The format, its proof and what it refuses."""

import dataclasses
import itertools

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.fixed import LARGEST_HIDDEN, convert
from quadjax.export.integers import ONE
from quadjax.export.proof import error_bound, prove
from quadjax.export.ranges import declare, parse_overrides
from quadjax.export.report import float64_commands
from quadjax.race.layout import Field, Layout
from quadjax.race.observations import Observation, make_layout
from quadjax.vehicle.motor import MODEL
from tests.export.support import POLICIES, made_policy, named_network

FEW = ["motor 64", "rate", "linear"]
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in POLICIES if name not in FEW]


@pytest.mark.parametrize("name", [*FEW, *SLOW])
def test_error_is_within_the_proven_bound(name):
    policy, network = named_network(name)
    bound = prove(network, policy).error_bound
    rng = np.random.default_rng(0)
    x = (
        rng.uniform(-1, 1, (3000, network.inputs))
        * network.box.ranges
        * rng.choice([0.1, 1], (3000, 1))
    )
    x = x.astype(np.float32)
    error = np.abs(emulator.commands(network, x) - float64_commands(policy, x)).max(axis=0)
    assert np.all(error <= bound)
    assert np.all(error <= 0.5 if policy.vehicle == "motor" else error <= 6e-4)


@pytest.mark.parametrize("name", ["narrow", pytest.param("odd", marks=pytest.mark.slow)])
def test_the_bound_holds_for_the_largest_error_that_a_search_finds(name):
    policy, network = named_network(name)
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


def test_proof_bounds_hold_at_the_worst_corner_of_every_first_row():
    policy, network = named_network("motor 64")
    proof = prove(network, policy)
    first = network.layers[0]
    for row in range(8):
        corner = np.where(first.weights[row] > 0, ONE, -ONE)[None]
        _, trace = emulator.forward_traced(network, corner)
        assert int(trace[0][0, row]) == proof.rows[0][row].high


def test_hidden_values_stay_in_thirty_bits():
    _, network = named_network("motor 64")
    signs = np.array(list(itertools.product((-1, 1), repeat=8)))
    corners = np.tile(signs, (1, 3)) * ONE
    _, trace = emulator.forward_traced(network, corners)
    assert max(int((sums >> 32).max()) for sums in trace[:-1]) <= LARGEST_HIDDEN


def test_a_neuron_that_is_never_active_costs_nothing():
    policy = made_policy(8)
    policy.layers[0][1][3] = -1e9
    network = convert(policy)
    assert prove(network, policy).inactive[0] == 1
    assert not network.hidden[0].weights[3].any()


def test_a_corrupted_row_fails_the_proof_by_name():
    policy, network = named_network("rate")
    for layer, row in ((0, 2), (1, 5), (3, 1)):
        layers = list(network.layers)
        weights, bias = layers[layer].weights.copy(), layers[layer].bias.copy()
        weights[row], bias[row] = 2**31 - 1, 2**62 + 2**61
        layers[layer] = dataclasses.replace(layers[layer], weights=weights, bias=bias)
        broken = dataclasses.replace(network, hidden=tuple(layers[:-1]), output=layers[-1])
        with pytest.raises(InputError, match=f"layer {layer}, row {row}"):
            prove(broken, policy)


def test_refuses_weights_that_are_not_finite_by_name():
    for value in (np.nan, np.inf):
        policy = made_policy(8)
        policy.layers[1][0][2, 6] = value
        with pytest.raises(InputError, match="layer 1, row 6"):
            convert(policy)


def test_refuses_other_activations():
    with pytest.raises(InputError, match="layer 0, row 0.*unsupported"):
        convert(made_policy(8, activation="tanh"))


def test_refuses_weights_without_room_for_a_command():
    policy = made_policy(8)
    policy.layers[-1][0][:, 2] = np.float32(1e30)
    with pytest.raises(InputError, match="layer 3, row 2.*range proof fails"):
        convert(policy)


def test_refuses_motor_commands_that_no_uint16_holds():
    policy = dataclasses.replace(made_policy(8), command_high=np.full(4, 70000.0))
    with pytest.raises(InputError, match="65535"):
        convert(policy)


def test_ranges_are_powers_of_two_of_known_names():
    policy = made_policy(8)
    assert declare(policy, {"velocity": 32.0}).ranges[4] == 32.0
    for ranges in ({"velocity": 30.0}, {"velocity": 0.0}, {"speed": 8.0}, {"velocity": np.nan}):
        with pytest.raises(InputError):
            declare(policy, ranges)
    with pytest.raises(InputError):
        parse_overrides(["velocity"])
    with pytest.raises(InputError, match="velocity has two ranges"):
        parse_overrides(["velocity=32", "position=8", "velocity=16"])
    unwrapped = dataclasses.replace(
        policy, layout=make_layout(MODEL, Observation(wrap_next_yaw=False))
    )
    assert declare(unwrapped).ranges[19] == 8.0


def test_refuses_observations_without_c():
    policy = made_policy(8)
    fields = policy.layout.fields
    extra = dataclasses.replace(policy, layout=Layout((*fields, Field("wind", 2, "m/s", "body"))))
    with pytest.raises(InputError, match="observes 'wind' .2 numbers., which has no C"):
        declare(extra)
    with pytest.raises(InputError, match="vehicle model 'own' has no C"):
        convert(dataclasses.replace(policy, vehicle="own"))


def test_refuses_a_range_that_flights_leave():
    box = declare(made_policy(8))
    x = np.zeros((3, 24), np.float32)
    box.check(x)
    x[1, 4] = 20.0
    with pytest.raises(InputError, match=r"velocity reaches 20 m/s, declared \+-16.*velocity=32"):
        box.check(x)
