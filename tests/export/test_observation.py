"""The observation and the gates of the C next to the environment's."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.export import race_source
from quadjax.export.network import convert as fixed_network
from quadjax.export.observation import make_observation
from quadjax.export.states import as_in_c, observe
from quadjax.race import openings
from quadjax.race.layout import Layout
from quadjax.race.track import gate
from tests.export.support import (
    config_of,
    convert,
    library,
    made,
    random_states,
    random_targets,
    with_weights,
)

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
def test_the_c_observes_what_the_environment_does(name, tmp_path):
    policy, own = observing(name)
    of = convert(policy, own, tmp_path)
    states, targets = random_states(policy, own, 500), random_targets(own, 500)
    rows = as_in_c(own.environment.layout, own.environment.model, states)
    found, wanted = (
        library(of, tmp_path / "c").observe(rows, targets),
        observe(own, states, targets),
    )
    error = np.abs(found - wanted) / of.in_c.network.box.ranges
    if "attitude" in policy.layout:  # the same angle on both sides of half a turn
        yaw = policy.layout.slice("attitude").stop - 1
        error[:, yaw] = np.minimum(error[:, yaw], np.abs(error[:, yaw] - 2 * np.pi / 4.0))
    assert error.max() < 2e-6
    assert (found != 0.0).any(axis=0).mean() >= 0.75


def test_a_disturbance_that_is_not_observed_is_zero():
    policy, own = rearranged(("moment_ext", "position"), "none")
    policy = with_weights(policy, (8,), 0.5)
    box = fixed_network(policy, {"position": 32.0}).box
    observation = make_observation(box, policy, own.environment, own.params)
    assert not observation.scales[:3].any() and observation.observed == {"position"}


GATES = (
    "track.gates=[{position: [0, 2, -2], yaw_deg: 30, %s}, {position: [3, 0, -1.5], yaw_deg: -80}]"
)
BODY = "rules.body_radius=0.2"
WANDERING = {  # the policy, and overrides of its race
    "square": ("indi", ()),
    "world box": ("e2e", ("rules.gate_test=world_box",)),
    "interpolated, with a body": ("e2e", ("rules.gate_test=interpolated", BODY)),
    "tilted": ("e2e", (GATES % "pitch_deg: -35, roll_deg: 20", "rules.gate_test=interpolated")),
    "tilted and round": ("e2e", (GATES % "pitch_deg: -35, shape: circle",)),
}


def wander(own, steps, seed=0):
    """Positions (steps, 3) float32 to every gate in turn, partly beside it, and their targets.

    The targets are those of the simulator's rule after each position; a step is 0.2 m.
    """
    rng, track = np.random.default_rng(seed), own.params.track
    centers = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    ahead = np.stack([np.asarray(track.cos_yaw), np.asarray(track.sin_yaw)], axis=1)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)
    radius, test = own.params.rules.body_radius, own.params.rules.gate_test
    less = jnp.float32(0.0 if radius is None else -radius)

    @jax.jit
    def follow(before, after, target):
        passed, _ = openings.crossing(
            Vec3.of(before), Vec3.of(after), gate(track, target), less, test
        )
        return (target + passed) % len(centers)

    target, position, path, targets = 0, centers[-1].astype(np.float32), [], []
    while len(path) < steps:
        aside, above = rng.uniform(-1.6, 1.6, 2) * half[target]
        way = np.array([*ahead[target], 0.0])
        slant = 0.5 * way + rng.uniform(-0.4, 0.4) * np.array([-way[1], way[0], 0.0])
        goal = centers[target] + np.array([-way[1] * aside, way[0] * aside, above])
        ends = np.array([position, goal - slant, goal + slant])
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            count = max(2, round(np.linalg.norm(b - a) / 0.2))
            for now in np.float32(a + np.linspace(0.03, 1.0, count)[:, None] * (b - a)):
                target = int(follow(position, now, target))
                position = now
                path.append(now)
                targets.append(target)
    return np.array(path), np.array(targets)


@pytest.mark.parametrize("kind", WANDERING)
def test_gates_along_a_wandering_path_are_the_simulators(kind, tmp_path):
    """By the race's own rule, from before the gates, through them and beside them."""
    name, overrides = WANDERING[kind]
    policy, _ = made(name)
    own = race_source.policy_race(config_of(name, *overrides), policy, "test")
    positions, targets = wander(own, 1500)
    events = library(convert(policy, own, tmp_path), tmp_path / "c").race(
        positions, int(targets[0])
    )
    np.testing.assert_array_equal(events[:, 1], targets)
    none, passed, missed = np.bincount(events[:, 0], minlength=3)
    assert min(none, passed, missed) > 10


def test_an_oblique_passage_counts_where_the_line_meets_the_plane(tmp_path):
    """At 20 m/s and 45 degrees the first sample behind the plane is 0.2 m aside."""
    policy, _ = made("e2e")
    track = "track.gates=[{position: [0, 0, -1.5]}, {position: [5, 0, -1.5]}]"
    for rule, event in (("interpolated", 1), ("square", 2)):
        config = config_of("e2e", track, f"rules.gate_test={rule}")
        own = race_source.policy_race(config, policy, "test")
        c = library(convert(policy, own, tmp_path / rule), tmp_path / rule / "c")
        path = np.array([[-0.05, 0.35, -1.5], [0.15, 0.55, -1.5]])  # half a gate is 0.5 m
        assert c.race(path, 0)[-1].tolist() == [event, int(event == 1)]


def test_a_position_that_is_not_finite_is_none(tmp_path):
    policy, own = made("published racing")
    c, track = library(convert(policy, own, tmp_path), tmp_path / "c"), own.params.track
    yaw = float(track.yaw[0])
    center = np.array([float(x[0]) for x in track.position.components()])
    ahead, behind = (center + s * np.array([np.cos(yaw), np.sin(yaw), 0]) for s in (0.1, -0.1))
    nowhere = np.full(3, np.nan)
    assert c.race(np.array([behind, ahead]), 0)[:, 0].tolist() == [0, 1]
    assert c.race(np.array([nowhere, ahead]), 0)[:, 0].tolist() == [0, 0]
    assert c.race(np.array([behind, nowhere, ahead]), 0)[:, 0].tolist() == [0, 0, 1]


def test_a_next_gate_outside_its_range_is_refused():
    policy, own = made("e2e")
    far = race_source.policy_race(
        config_of("e2e", "track.gates=[{position: [0, 0, -2]}, {position: [9, 0, -2]}]"),
        policy,
        "test",
    )
    box = fixed_network(policy).box
    with pytest.raises(InputError, match="gate 0: next_position is 9, declared .*next_position=16"):
        make_observation(box, policy, own.environment, far.params)
