"""The observation, the gate logic and the estimator in fixed point, next to the Python."""

import dataclasses
import math

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export import emulator, flights
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.convert import export_c
from quadjax.export.disturbances import make_estimator
from quadjax.export.estimator_emulator import estimate
from quadjax.export.network import convert
from quadjax.export.race_tables import make_tables
from quadjax.export.ranges import track_ranges
from quadjax.export.states import observe
from quadjax.export.verify import measurements
from quadjax.race.layout import Layout
from quadjax.vehicle.protocol import VehicleParams
from tests.export.support import (
    WIDE,
    fixed_policy,
    library,
    made_policy,
    made_residual,
    own_race,
    random_states,
)


def states_of(policy, own, count, seed=0):
    """States that a race may meet, (n, state_size) float32."""
    rng = np.random.default_rng(seed)
    return random_states(rng, count, own, policy.command_low, policy.command_high)


def tables_of(policy, own, ranges=None):
    network = convert(policy, ranges)
    return network, make_tables(network.box, policy, own.choices, own.params)


@pytest.mark.parametrize("vehicle, track", [("motor", "square4.yaml"), ("rate", "figure8.yaml")])
def test_observation_is_the_environments(vehicle, track):
    policy = made_policy(8, vehicle)
    own = own_race(policy, track=track)
    network, tables = tables_of(policy, own, WIDE | {"next_position": 16.0})
    states, targets = states_of(policy, own, 2000), np.arange(2000) % tables.gates
    states[:, 8] *= 2.0  # a yaw of several turns
    q, status = emulator.observe(tables, states, targets)
    assert not status.any()
    error = np.abs(q / 2.0**30 * network.box.ranges - observe(own, states, targets))
    # The yaw of 18 rad itself has float32 steps of 2e-6 rad in the environment.
    assert np.all(error <= np.maximum(1e-6 * network.box.ranges, 4e-6))


def test_yaw_wraps_at_any_turn_without_a_loop():
    yaw = np.linspace(-63.0, 63.0, 20001)
    wrapped = emulator.wrap(np.rint(yaw * 2.0**30).astype(np.int64)) / 2.0**30
    exact = np.arctan2(np.sin(yaw), np.cos(yaw))
    away = np.abs(np.abs(exact) - np.pi) > 1e-6
    assert np.abs(wrapped - exact)[away].max() < 1e-7
    assert np.abs(wrapped).max() <= np.pi + 1e-6


def test_state_status_and_edges():
    policy = made_policy(8)
    own = own_race(policy)
    _, tables = tables_of(policy, own)
    states = states_of(policy, own, 3)
    states[0, 2], states[1, 8], states[2, 3:5] = np.nan, np.inf, 20.0
    q, status = emulator.observe(tables, states, np.zeros(3, int))
    assert status[:, :2].tolist() == [[0, 4], [256, 0], [0, 0]]  # clipped, NaN
    assert status[2, 2] != 0  # 20 m/s is in the state's range, not in the network's
    assert np.abs(q).max() <= 2**30


def test_gates_are_passed_and_missed():
    policy = made_policy(8, "rate")
    _, tables = tables_of(policy, own_race(policy))
    unit, gate = 2.0 ** (30 - tables.exponents[0]), np.array([2.0, -1.5, -1.5])
    ahead = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0])
    right, up = np.array([-ahead[1], ahead[0], 0.0]), np.array([0, 0, -1.0])

    def event(aside, along=0.1):
        ends = (gate + aside - along * ahead, gate + aside + along * ahead)
        points = [np.rint(p * unit).astype(np.int64)[None] for p in ends]
        return int(emulator.gate_event(tables, *points, np.zeros(1, int))[0])

    assert event(0.0 * up) == event(0.49 * right) == emulator.PASSED
    assert event(0.0 * up, -0.1) == emulator.NO_EVENT
    assert event(0.51 * right) == event(0.51 * up) == emulator.MISSED


GATES = (
    "gates:\n  - {position: [0, 2, -2], yaw_deg: 30, %s}\n"
    "  - {position: [3, 0, -1.5], yaw_deg: -80}\n"
)
TRACKS = {  # of a wandering path: the config, and the first of two gates
    "rate": ("indi", ""),
    "world box": ("e2e_paper +authors_code", ""),
    "tilted": (None, "pitch_deg: -35, roll_deg: 20"),
    "tilted and round": (None, "pitch_deg: -35, shape: circle"),
}


@pytest.mark.parametrize(
    "kind",
    ["rate", "world box", "tilted and round", pytest.param("tilted", marks=pytest.mark.slow)],
)
def test_gates_along_a_wandering_path_are_the_simulators(kind, tmp_path):
    config, first = TRACKS[kind]
    vehicle, track = "rate" if kind == "rate" else "motor", None
    if first:
        track = str(tmp_path / "track.yaml")
        (tmp_path / "track.yaml").write_text(GATES % first)
    policy = made_policy(8, vehicle)
    own = own_race(policy, config, track)
    _, tables = tables_of(policy, own, {"next_yaw": 8.0})
    assert tables.world_box == (kind == "world box")
    level = tables.track["axes"][:, [2, 5, 6, 7]] == 0
    assert level.all() == ("tilted" not in kind)
    assert tables.track["round"].any() == ("round" in kind)
    positions, targets = flights.wander(own, 6000 if first else 3000)
    q = np.trunc(positions.astype(np.float64) * 2.0 ** (30 - tables.exponents[0])).astype(np.int64)
    events = emulator.gate_event(tables, q[:-1], q[1:], targets[:-1])
    assert np.array_equal(events == emulator.PASSED, targets[1:] != targets[:-1])
    assert np.sum(events == emulator.PASSED) > 5 and np.sum(events == emulator.MISSED) > 5
    rows = library(fixed_policy(policy, own), tmp_path / "c").events(positions, int(targets[0]))
    assert rows[1:, 0].tolist() == events.tolist()


def test_a_track_of_many_gates_has_its_own_self_tests(tmp_path):
    policy = made_policy(8, "rate")
    own = own_race(policy)
    _, tables = tables_of(policy, own)
    rows = np.arange(301) % tables.gates
    many = {"track": tables.track[rows], "next_gate": tables.next_gate[rows]}
    states = states_of(policy, own, 40)
    library(fixed_policy(policy, own, states, np.arange(40) * 7, **many), tmp_path)


def test_a_policys_own_limits_are_the_vehicles():
    policy, rate = made_policy(8), made_policy(8, "rate")
    faster = dataclasses.replace(policy, command_high=np.full(4, 12000.0))
    constants = own_race(faster).params.vehicle.constants
    assert (float(constants.rpm_min), float(constants.rpm_max)) == (3000.0, 12000.0)
    high = np.array([3.0, 3.0, 2.0, 16.0])
    other = dataclasses.replace(rate, command_low=-high * [1, 1, 1, 0], command_high=high)
    constants = own_race(other).params.vehicle.constants
    assert (float(constants.r_max), float(constants.thrust_max)) == (2.0, 16.0)
    unequal = dataclasses.replace(policy, command_low=np.arange(4.0))
    with pytest.raises(InputError, match="no motor vehicle has these limits.*rpm_min, rpm_max"):
        own_race(unequal)
    with pytest.raises(InputError, match="no rate vehicle has these limits"):
        own_race(dataclasses.replace(rate, command_low=np.full(4, -1.0)))


@pytest.mark.parametrize("with_residual, rate, cutoff", [(True, 512.0, 8.0), (False, 400.0, 16.0)])
def test_estimator_is_the_reference(with_residual, rate, cutoff):
    rng = np.random.default_rng(0)
    constants = own_race(made_policy(8)).params.vehicle.constants
    residual = made_residual(rng) if with_residual else None
    tables = make_estimator(constants, residual, rate, cutoff)
    measured = measurements.tumbling(rng, rate, 4.0)
    vehicle = VehicleParams(constants, residual)
    exact = measurements.estimate_float64(vehicle, measured, rate, cutoff)
    error = np.abs(estimate(tables, measured) - exact)
    assert error[:, :3].max() < 1e-6 and error[:, 3:].max() < 2e-5


def test_impossible_numbers_of_the_estimator_are_refused(tmp_path):
    for rate in (0.0, -1.0, math.inf, math.nan, 1e300, 1e-300):  # before anything is read
        with pytest.raises(InputError, match="sample rate .* allowed: 1 to 100000 Hz"):
            export_c(tmp_path / "none.npz", tmp_path / "out", sample_rate=rate, cutoff=rate)
        with pytest.raises(InputError, match="cut-off .* allowed: 0.512 to 128 Hz"):
            export_c(tmp_path / "none.npz", tmp_path / "out", cutoff=rate)
    with pytest.raises(InputError, match="cut-off 4 Hz has no effect: .*'rate'"):
        export_c(PRETRAINED / "indi.npz", tmp_path / "out", cutoff=4.0)
    assert not (tmp_path / "out").exists()


def rearranged(policy, names, source="ground_truth"):
    """A policy of other fields, in another order."""
    fields = [policy.layout[name] for name in names]
    fields = [dataclasses.replace(f, source=source if f.source else "") for f in fields]
    layout = Layout(tuple(fields))
    kernel, bias = made_policy(8).layers[0]
    first = (np.resize(kernel, (layout.size, 8)), bias)
    return dataclasses.replace(policy, layout=layout, layers=(first, *policy.layers[1:]))


EVERY = ("next_yaw", "rates", "force_ext", "velocity", "next_position", "rpm", "attitude")
LAYOUTS = {
    "another order": (*EVERY, "moment_ext", "position"),
    "the gate": ("next_yaw", "next_position"),
    "without a gate": ("force_ext", "rpm"),
}
FEW = [pytest.param(name, marks=pytest.mark.slow) for name in list(LAYOUTS)[1:]]


@pytest.mark.parametrize("name", ["another order", *FEW])
def test_any_order_and_subset_of_the_fields_has_c(name, tmp_path):
    policy = rearranged(made_policy(8), LAYOUTS[name])
    own = own_race(policy)
    network, tables = tables_of(policy, own)
    states, targets = states_of(policy, own, 50), np.arange(50) % tables.gates
    library(fixed_policy(policy, own, states, targets), tmp_path)
    q, _ = emulator.observe(tables, states, targets)
    ranges = network.box.ranges
    expected = np.clip(observe(own, states, targets), -ranges, ranges)
    assert np.abs(q / 2.0**30 * ranges - expected).max() < 2e-5


def test_the_estimate_is_observed_as_the_disturbance_of_the_state():
    policy = rearranged(made_policy(8), ("moment_ext", "force_ext"), "estimated")
    own = own_race(policy)
    assert own.params.estimator is not None
    states = states_of(policy, own, 20)
    half = np.array([0.03, 0.03, 0.01, 0.5])
    found = observe(own, states, np.zeros(20, int))
    assert np.allclose(found, states[:, [16, 17, 18, 21]] / half, atol=1e-6)


def test_a_gate_far_away_widens_the_ranges(tmp_path):
    (tmp_path / "far.yaml").write_text(
        "gates:\n  - {position: [-9, 0, -2]}\n  - {position: [9, 0, -2]}\n"
    )
    policy, path = made_policy(8), tmp_path / "policy.npz"
    policy.save(path)
    own = own_race(policy, track=str(tmp_path / "far.yaml"))
    wide = {"position": 32.0, "next_position": 32.0}
    assert track_ranges(policy.layout, own.params.track) == wide
    assert track_ranges(policy.layout, own_race(policy).params.track) == {}
    rollouts = flights.Rollouts(*(np.zeros((0, 1)),) * 3)
    converted = convert_policy(policy, own, Options("far"), "far", path, rollouts)
    assert converted.fixed.network.box.declared["next_position"] == 32.0
    narrow = Options("far", {"next_position": 16.0})
    with pytest.raises(InputError, match="gate 0: next_position is 18, declared .-16"):
        convert_policy(policy, own, narrow, "far", path, rollouts)
