"""The observation, the gate logic and the estimator in fixed point, beside the Python."""

import dataclasses
import math

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export import estimator_emulator, flights, race_emulator
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.convert import export_c
from quadjax.export.estimator_tables import make_estimator
from quadjax.export.fixed import convert
from quadjax.export.race_source import own_race as race_in
from quadjax.export.race_tables import make_tables, track_ranges
from quadjax.export.verify import measurements
from quadjax.policy.race import race_of_policy
from quadjax.race.layout import Layout
from quadjax.vehicle.protocol import VehicleParams
from tests.export.support import WIDE, fixed_policy, library, made_policy, made_residual


def own_race(policy, config=None, track=None):
    found, origin = race_of_policy(policy, config=config, track=track)
    return race_in(found, policy, origin)


def random_states(rng, count, vehicle):
    """States that a race may meet, (n, state_size) float32; yaw wound up several turns."""
    parts = [rng.uniform(-4, 4, (count, 3)), rng.normal(0, 5, (count, 3))]
    parts += [rng.uniform(-1, 1, (count, 2)), rng.uniform(-20, 20, (count, 1))]
    parts.append(rng.normal(0, 4, (count, 3)))
    if vehicle == "rate":
        parts.append(rng.uniform(0, 15, (count, 1)))
    else:
        parts.append(rng.uniform(3000, 11000, (count, 4)))
        parts.append(rng.uniform(-1, 1, (count, 3)) * [0.03, 0.03, 0.01])
        parts.append(rng.uniform(-0.5, 0.5, (count, 3)))
    return np.concatenate(parts, axis=1).astype(np.float32)


@pytest.mark.parametrize(
    "vehicle, track", [("motor", "square4.yaml"), ("rate", "figure8.yaml")], ids=["motor", "rate"]
)
def test_observation_is_the_environments(vehicle, track):
    policy = made_policy(8, vehicle)
    own = own_race(policy, track=track)
    ranges = {k: v for k, v in WIDE.items() if k != "next_position"} | {"next_position": 16.0}
    network = convert(policy, ranges)
    tables = make_tables(network.box, policy, own.choices, own.params)
    rng = np.random.default_rng(0)
    states, targets = random_states(rng, 2000, vehicle), rng.integers(0, tables.gates, 2000)
    observed = race_emulator.observe(tables, states, targets)
    assert not (observed.clipped | observed.nan | observed.outside).any()
    shown = flights.observe(own, states, targets)
    error = np.abs(observed.q / 2.0**30 * network.box.ranges - shown)
    # The yaw of 20 rad itself has float32 steps of 2e-6 rad in the environment.
    tolerance = np.maximum(1e-6 * network.box.ranges, 4e-6)
    assert np.all(error <= tolerance)


def test_yaw_wraps_at_any_turn_without_a_loop():
    yaw = np.linspace(-63.0, 63.0, 20001)
    wrapped = race_emulator.wrap(np.rint(yaw * 2.0**30).astype(np.int64)) / 2.0**30
    exact = np.arctan2(np.sin(yaw), np.cos(yaw))
    away = np.abs(np.abs(exact) - np.pi) > 1e-6
    assert np.abs(wrapped - exact)[away].max() < 1e-7
    assert np.abs(wrapped).max() <= np.pi + 1e-6


def test_state_status_and_edges():
    policy = made_policy(8)
    own = own_race(policy)
    tables = make_tables(convert(policy).box, policy, own.choices, own.params)
    states = random_states(np.random.default_rng(0), 3, "motor")
    states[0, 2], states[1, 8], states[2, 3] = np.nan, np.inf, 20.0
    observed = race_emulator.observe(tables, states, np.zeros(3, int))
    assert observed.nan.tolist() == [4, 0, 0]
    assert observed.clipped.tolist() == [0, 256, 0]
    assert observed.outside[2] != 0  # 20 m/s is in the state's range, not in the network's
    assert np.abs(observed.q).max() <= 2**30


def test_gates_are_passed_and_missed():
    policy = made_policy(8, "rate")
    own = own_race(policy)
    tables = make_tables(convert(policy).box, policy, own.choices, own.params)
    unit = 2.0 ** (30 - tables.exponents[0])
    gate = np.array([2.0, -1.5, -1.5])
    ahead = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0])
    right = np.array([-ahead[1], ahead[0], 0.0])

    def event(start, end):
        points = [np.rint(p * unit).astype(np.int64)[None] for p in (start, end)]
        return int(race_emulator.gate_event(tables, *points, np.zeros(1, int))[0])

    through = (gate - 0.1 * ahead, gate + 0.1 * ahead)
    assert event(*through) == race_emulator.PASSED
    assert event(*reversed(through)) == race_emulator.NO_EVENT
    beside = [p + 0.51 * right for p in through]
    assert event(*beside) == race_emulator.MISSED
    assert event(*[p + 0.49 * right for p in through]) == race_emulator.PASSED
    above = [p - np.array([0, 0, 0.51]) for p in through]
    assert event(*above) == race_emulator.MISSED


@pytest.mark.parametrize("config", ["indi", "e2e_paper +authors_code"])
def test_gates_along_a_wandering_path_are_the_simulators(config):
    policy = made_policy(8, "rate" if config == "indi" else "motor")
    own = own_race(policy, config=config)
    world_box = own.params.rules.gate_test == "world_box"
    assert world_box == (config == "e2e_paper +authors_code")
    network = convert(policy, {"next_yaw": 8.0})
    tables = make_tables(network.box, policy, own.choices, own.params)
    positions, targets = flights.wander(own, 3000)
    q = np.trunc(positions.astype(np.float64) * 2.0 ** (30 - tables.exponents[0])).astype(np.int64)
    events = race_emulator.gate_event(tables, q[:-1], q[1:], targets[:-1])
    assert np.array_equal(events == race_emulator.PASSED, targets[1:] != targets[:-1])
    assert np.sum(events == race_emulator.PASSED) > 5 and np.sum(events == race_emulator.MISSED) > 5


TILTED = {
    "tilted": "pitch_deg: -35, roll_deg: 20",
    "round": "shape: circle",
    "tilted and round": "pitch_deg: -35, shape: circle",
}


@pytest.mark.parametrize(
    "kind",
    [*(pytest.param(k, marks=pytest.mark.slow) for k in list(TILTED)[:2]), "tilted and round"],
)
def test_tilted_and_round_gates_are_the_simulators(kind, tmp_path):
    (tmp_path / "track.yaml").write_text(
        f"gates:\n  - {{position: [0, 2, -2], yaw_deg: 30, {TILTED[kind]}}}\n"
        "  - {position: [3, 0, -1.5], yaw_deg: -80}\n"
    )
    policy = made_policy(8)
    own = own_race(policy, track=str(tmp_path / "track.yaml"))
    network = convert(policy)
    tables = make_tables(network.box, policy, own.choices, own.params)
    assert (tables.axes is None, tables.circle is None) == (kind == "round", kind == "tilted")
    positions, targets = flights.wander(own, 6000)
    q = np.trunc(positions.astype(np.float64) * 2.0 ** (30 - tables.exponents[0])).astype(np.int64)
    events = race_emulator.gate_event(tables, q[:-1], q[1:], targets[:-1])
    assert np.array_equal(events == race_emulator.PASSED, targets[1:] != targets[:-1])
    assert np.sum(events == race_emulator.PASSED) > 5 and np.sum(events == race_emulator.MISSED) > 5
    states = random_states(np.random.default_rng(0), 20, "motor")
    made = fixed_policy(policy, own, states, np.arange(20) % tables.gates)
    rows = library(made, tmp_path / "c").events(positions, int(targets[0]))
    assert rows[1:, 0].tolist() == events.tolist()


def test_a_track_of_many_gates_has_its_own_self_tests(tmp_path):
    policy = made_policy(8, "rate")
    own = own_race(policy)
    tables = make_tables(convert(policy).box, policy, own.choices, own.params)
    of_gates = ("gate_position", "gate_cos", "gate_sin", "gate_yaw", "half_size", "next_gate")
    arrays = {name: getattr(tables, name) for name in of_gates}
    many = {name: np.resize(x, (301, *x.shape[1:])) for name, x in arrays.items()}
    states, targets = random_states(np.random.default_rng(0), 40, "rate"), np.arange(40) * 7
    library(fixed_policy(policy, own, states, targets, **many), tmp_path)


def test_a_policys_own_limits_are_the_vehicles():
    policy = dataclasses.replace(made_policy(8), command_high=np.full(4, 12000.0))
    constants = own_race(policy).params.vehicle.constants
    assert (float(constants.rpm_min), float(constants.rpm_max)) == (3000.0, 12000.0)
    rate = made_policy(8, "rate")
    high = np.array([3.0, 3.0, 2.0, 16.0])
    rate = dataclasses.replace(rate, command_low=-high * [1, 1, 1, 0], command_high=high)
    constants = own_race(rate).params.vehicle.constants
    assert (float(constants.r_max), float(constants.thrust_max)) == (2.0, 16.0)


def test_refuses_limits_that_no_vehicle_has():
    unequal = dataclasses.replace(made_policy(8), command_low=np.arange(4.0))
    with pytest.raises(InputError, match="no motor vehicle has these limits.*rpm_min, rpm_max"):
        own_race(unequal)
    skewed = dataclasses.replace(made_policy(8, "rate"), command_low=np.full(4, -1.0))
    with pytest.raises(InputError, match="no rate vehicle has these limits"):
        own_race(skewed)


@pytest.mark.parametrize("with_residual, rate, cutoff", [(True, 512.0, 8.0), (False, 400.0, 16.0)])
def test_estimator_is_the_reference(with_residual, rate, cutoff):
    rng = np.random.default_rng(0)
    constants = own_race(made_policy(8)).params.vehicle.constants
    residual = made_residual(rng) if with_residual else None
    tables = make_estimator(constants, residual, rate, cutoff)
    measured = measurements.tumbling(rng, rate, 4.0)
    memory = estimator_emulator.start(tables, measured[:1])
    found = np.concatenate(
        [
            estimator_emulator.outputs(tables, estimator_emulator.update(tables, memory, row[None]))
            for row in measured
        ]
    )
    vehicle = VehicleParams(constants, residual)
    error = np.abs(found - measurements.estimate_float64(vehicle, measured[None], rate, cutoff)[0])
    assert error[:, :3].max() < 1e-6
    assert error[:, 3:].max() < 2e-5


def test_estimator_refuses_a_cutoff_without_room():
    constants = own_race(made_policy(8)).params.vehicle.constants
    with pytest.raises(InputError, match="cut-off"):
        make_estimator(constants, None, 512.0, 200.0)


def test_impossible_sample_rates_are_refused_before_anything_is_read(tmp_path):
    for rate in (0.0, -1.0, math.inf, math.nan, 1e300, 1e-300):
        with pytest.raises(InputError, match="sample rate .* allowed: 1 to 100000 Hz"):
            export_c(tmp_path / "none.npz", tmp_path / "out", sample_rate=rate, cutoff=rate)
        with pytest.raises(InputError, match="cut-off .* allowed: 0.512 to 128 Hz"):
            export_c(tmp_path / "none.npz", tmp_path / "out", cutoff=rate)
        assert not (tmp_path / "out").exists()


def test_numbers_of_the_estimator_need_one(tmp_path):
    with pytest.raises(InputError, match="cut-off 4 Hz has no effect: .*'rate'"):
        export_c(PRETRAINED / "indi.npz", tmp_path / "out", cutoff=4.0)


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


@pytest.mark.parametrize(
    "name",
    ["another order", *(pytest.param(n, marks=pytest.mark.slow) for n in list(LAYOUTS)[1:])],
)
def test_any_order_and_subset_of_the_fields_has_c(name, tmp_path):
    policy = rearranged(made_policy(8), LAYOUTS[name])
    own = own_race(policy)
    network = convert(policy)
    tables = make_tables(network.box, policy, own.choices, own.params)
    rng = np.random.default_rng(0)
    states, targets = random_states(rng, 50, "motor"), rng.integers(0, tables.gates, 50)
    states[:, 3:6] /= 4.0
    library(fixed_policy(policy, own, states, targets), tmp_path)
    observed = race_emulator.observe(tables, states, targets)
    error = observed.q / 2.0**30 * network.box.ranges - flights.observe(own, states, targets)
    assert np.abs(error).max() < 2e-5


def test_the_estimate_is_observed_as_the_disturbance_of_the_state():
    policy = rearranged(made_policy(8), ("moment_ext", "force_ext"), "estimated")
    own = own_race(policy)
    assert own.params.estimator is not None
    states = random_states(np.random.default_rng(0), 20, "motor")
    found = flights.observe(own, states, np.zeros(20, int))
    half = np.array([0.03, 0.03, 0.01, 0.5])
    assert np.allclose(found, states[:, [16, 17, 18, 21]] / half, atol=1e-6)


def test_a_gate_far_away_widens_the_ranges(tmp_path):
    (tmp_path / "far.yaml").write_text(
        "gates:\n  - {position: [-9, 0, -2]}\n  - {position: [9, 0, -2]}\n"
    )
    policy = made_policy(8)
    own = own_race(policy, track=str(tmp_path / "far.yaml"))
    assert track_ranges(policy.layout, own.params.track) == {
        "position": 32.0,
        "next_position": 32.0,
    }
    assert track_ranges(policy.layout, own_race(policy).params.track) == {}
    rollouts = flights.Rollouts(*(np.zeros((0, 1)),) * 3)
    path = tmp_path / "policy.npz"
    policy.save(path)
    converted = convert_policy(policy, own, Options("far"), "far", path, rollouts)
    assert converted.network.box.declared["next_position"] == 32.0
    narrow = Options("far", {"next_position": 16.0})
    with pytest.raises(InputError, match="gate 0: next_position is 18, declared .-16"):
        convert_policy(policy, own, narrow, "far", path, rollouts)
