"""The observation and the gates in fixed point, next to the environment's."""

import dataclasses

import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.export import emulator, flights, race_source
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.network import convert
from quadjax.export.race_tables import make_tables
from quadjax.export.ranges import track_ranges
from quadjax.export.states import observe
from quadjax.race.layout import Layout
from tests.export.support import (
    config_of,
    fixed,
    fixed_policy,
    library,
    made,
    random_states,
    random_targets,
    with_weights,
)


def tables_of(policy, own, ranges=None):
    """The policy as a network of integers, and its race."""
    network = convert(policy, ranges)
    return network, make_tables(network.box, policy, own.environment, own.params)


FIELDS = ("next_yaw", "rates", "force_ext", "velocity", "next_position", "rpm", "attitude")
REARRANGED = {  # fields of e2e
    "another order": (*FIELDS, "moment_ext", "position"),
    "the gate": ("next_yaw", "next_position"),
    "without a gate": ("force_ext", "rpm"),
}


def rearranged(names, source="ground_truth"):
    """A policy of other fields, in another order, and its race."""
    policy, own = made("e2e")
    fields = [policy.layout[name] for name in names]
    fields = [dataclasses.replace(f, source=source if f.source else "") for f in fields]
    policy = dataclasses.replace(policy, layout=Layout(tuple(fields)))
    return policy, race_source.policy_race(own.config, policy, "test")


def observing(name):
    """A policy of some layout, and its race."""
    if name not in REARRANGED:
        return made(name)
    policy, own = rearranged(REARRANGED[name])
    return with_weights(policy, (8,), 0.5), own


FEW = ("published e2e", "everything", "racing, axes and more")
SLOW = ("published indi", "e2e with quaternions", "indi and more", *REARRANGED)


@pytest.mark.parametrize(
    "name", [*FEW, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_the_inputs_of_numpy_and_c_are_those_of_the_environment(name, tmp_path):
    policy, own = observing(name)
    states, targets = random_states(policy, own, 500), random_targets(own, 500)
    of_c = fixed_policy(policy, own, states[:50], targets[:50])
    q, status = emulator.observe(of_c.race, states, targets)
    ranges = of_c.network.box.ranges
    found, wanted = q / 2.0**30 * ranges, observe(own, states, targets)
    inside = (np.abs(wanted) < ranges).all(axis=1)
    assert not status[:, :2].any() and (status[:, 2] == 0).tolist() == inside.tolist()
    # The yaw of 9 rad itself has float32 steps of 1e-6 rad in the environment.
    error = np.abs(found - np.clip(wanted, -ranges, ranges))
    assert np.all(error <= np.maximum(1e-6 * ranges, 4e-6))
    assert inside.sum() > 50 and (found != 0.0).any(axis=0).mean() >= 0.75
    rows = library(of_c, tmp_path).observe(states, targets)
    np.testing.assert_array_equal(rows, np.concatenate([q, status], axis=1))


def test_the_estimate_is_observed_as_the_disturbance_of_the_state():
    policy, own = rearranged(("moment_ext", "force_ext"), "estimated")
    assert own.params.estimator is not None
    states = random_states(policy, own, 20)
    half = [high for field in policy.layout.fields for _, high in field.span]
    found = observe(own, states, np.zeros(20, int)) * half
    assert np.abs(found - states[:, [16, 17, 18, 21]]).max() < 1e-6


def test_yaw_wraps_at_any_turn_without_a_loop():
    yaw = np.linspace(-63.0, 63.0, 20001)
    wrapped = emulator.wrap(np.rint(yaw * 2.0**30).astype(np.int64)) / 2.0**30
    exact = np.arctan2(np.sin(yaw), np.cos(yaw))
    away = np.abs(np.abs(exact) - np.pi) > 1e-6
    assert np.abs(wrapped - exact)[away].max() < 1e-7
    assert np.abs(wrapped).max() <= np.pi + 1e-6


def test_states_out_of_range_are_clipped_and_reported():
    policy, own = made("e2e")
    _, tables = tables_of(policy, own)
    states = random_states(policy, own, 3)
    states[0, 2], states[1, 8], states[2, 3:5] = np.nan, np.inf, 20.0
    q, status = emulator.observe(tables, states, np.zeros(3, int))
    assert status[:, :2].tolist() == [[0, 4], [256, 0], [0, 0]]  # clipped, NaN
    assert status[2, 2] != 0  # 20 m/s is in the state's range, not in the network's
    assert np.abs(q).max() <= 2**30


GATES = (
    "track.gates=[{position: [0, 2, -2], yaw_deg: 30, %s}, {position: [3, 0, -1.5], yaw_deg: -80}]"
)
WANDERING = {  # the policy, and overrides of its race
    "rate": ("indi", ()),
    "world box": ("e2e", ("rules.gate_test=world_box",)),
    "tilted": ("e2e", (GATES % "pitch_deg: -35, roll_deg: 20",)),
    "tilted and round": ("e2e", (GATES % "pitch_deg: -35, shape: circle",)),
}


@pytest.mark.parametrize(
    "kind",
    ["rate", "world box", "tilted and round", pytest.param("tilted", marks=pytest.mark.slow)],
)
def test_gates_along_a_wandering_path_are_the_simulators(kind, tmp_path):
    name, overrides = WANDERING[kind]
    policy, _ = made(name)
    own = race_source.policy_race(config_of(name, *overrides), policy, "test")
    _, tables = tables_of(policy, own, {"next_yaw": 8.0})
    assert tables.world_box == (kind == "world box")
    level = tables.track["axes"][:, [2, 5, 6, 7]] == 0
    assert level.all() == ("tilted" not in kind)
    assert tables.track["round"].any() == ("round" in kind)
    positions, targets = flights.wander(own, 6000 if "tilted" in kind else 3000)
    q = np.trunc(positions.astype(np.float64) * 2.0 ** (30 - tables.exponents[0])).astype(np.int64)
    events = emulator.gate_event(tables, q[:-1], q[1:], targets[:-1])
    assert np.array_equal(events == emulator.PASSED, targets[1:] != targets[:-1])
    assert np.sum(events == emulator.PASSED) > 5 and np.sum(events == emulator.MISSED) > 5
    rows = library(fixed_policy(policy, own), tmp_path / "c").events(positions, int(targets[0]))
    assert rows[1:, 0].tolist() == events.tolist()


def test_a_track_of_many_gates_has_its_own_self_tests(tmp_path):
    policy, own = made("indi")
    tables = fixed("indi").race
    rows = np.arange(301) % tables.gates
    many = {"track": tables.track[rows], "next_gate": tables.next_gate[rows]}
    states = random_states(policy, own, 40)
    library(fixed_policy(policy, own, states, np.arange(40) * 7, **many), tmp_path)


def test_actions_span_the_policys_own_limits_within_the_vehicles():
    for name, low, high in (
        ("e2e", [2000.0] * 4, [12000.0] * 4),
        ("indi", [-3.0, -3.0, -2.0, 0.0], [3.0, 3.0, 2.0, 16.0]),
    ):
        policy, own = made(name)
        changed = dataclasses.replace(
            policy, command_low=np.array(low), command_high=np.array(high)
        )
        race = race_source.policy_race(own.config, changed, "test")
        constants = race.params.vehicle.constants
        ends = race.environment.model.command_range(constants)
        for action, wanted, limit in ((-1.0, low, ends[0]), (1.0, high, ends[1])):
            sent = race.environment.command(race.params, np.full(4, action, np.float32))
            clip = np.maximum if action < 0 else np.minimum
            np.testing.assert_allclose(
                jax.tree.leaves(sent), clip(wanted, jax.tree.leaves(limit)), rtol=1e-6
            )


def test_a_gate_far_away_widens_the_ranges(tmp_path):
    policy, near = made("e2e")
    far = config_of("e2e", "track.gates=[{position: [-9, 0, -2]}, {position: [9, 0, -2]}]")
    own = race_source.policy_race(far, policy, "test")
    wide = {"position": 32.0, "next_position": 32.0}
    assert track_ranges(policy.layout, own.params.track) == wide
    assert track_ranges(policy.layout, near.params.track) == {}
    policy.save(tmp_path / "policy.npz")
    rollouts = flights.Rollouts(*(np.zeros((0, 1)),) * 3)
    where = ("far", tmp_path / "policy.npz", rollouts)
    converted = convert_policy(policy, own, Options("far"), *where)
    assert converted.fixed.network.box.declared["next_position"] == 32.0
    narrow = Options("far", {"next_position": 16.0})
    with pytest.raises(InputError, match="gate 0: next_position is 18, declared .-16"):
        convert_policy(policy, own, narrow, *where)
