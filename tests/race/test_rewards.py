"""Every term of the reward, one step at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Vec3
from quadjax.race import rewards
from quadjax.race.environment import without_training_limits
from quadjax.race.rewards import REWARDS, Reward
from quadjax.race.rules import HIT_A_GATE
from quadjax.race.types import Step
from quadjax.vehicle.motor import MODEL
from tests import reference as ref
from tests.convert import state_of
from tests.race.support import level, make_race, normal, ruled, step, through

ONE_TO_GO = np.linalg.norm(ref.GATES[1] - through(0, 0.03, 0.2))  # 3 cm beyond the first gate


def weights(**kept):
    """Weights of which all others are zero, but computed: one program for all."""
    zeros = dict.fromkeys((name for name in REWARDS if name != "action_change"), 0.0)
    return as_leaves(Reward(**(zeros | {"gate_edge_reach": 1.0} | kept)))


@pytest.mark.parametrize(
    ("kept", "expected"),
    [  # flying on, passing, hitting
        ({"progress": 2.0}, (2 * 0.05, 0.0, 0.0)),
        ({"gate": 3.0}, (0.0, 3.0, 0.0)),
        ({"gate_offset": 4.0}, (0.0, -4 * np.hypot(0.03, 0.2), 0.0)),
        ({"next_gate_progress": 2.0}, (0.0, 2 * (np.hypot(0.02, 0.2) + 3 - ONE_TO_GO), 0.0)),
        ({"collision": 5.0}, (0.0, 0.0, -5.0)),
        ({"gate_edge": 4.0, "gate_edge_margin": 0.4}, (0.0, -4 * 0.1, -4 * 0.5)),
        ({"gate_edge": 4.0, "gate_edge_margin": 0.1}, (0.0, 0.0, -4 * 0.2)),
        (
            {"gate_edge": 4.0, "gate_edge_margin": 0.4, "gate_edge_reach": 0.45},
            (0.0, -4 * 0.1, -4 * 0.45),
        ),
        ({"time": 6.0}, (-0.06, -0.06, -0.06)),
        ({"body_rates": 7.0}, (-0.07 * 1.5, -0.07 * 1.5, -0.07 * 1.5)),
        ({"pitch_up": 8.0}, (0.0, -0.08 * 0.3, 0.08 * 0.3)),
        ({"distance": 9.0}, [-0.09 * x for x in (0.95, np.hypot(0.03, 0.2), np.hypot(0.03, 0.6))]),
    ],
)
def test_each_term_of_the_reward(kept, expected):
    rows = level(np.stack([through(0, -1), through(0, -0.02, 0.2), through(0, -0.02, 0.6)]), 0.0)
    rows[:, ref.V] = 5 * normal(0)
    environment, params = make_race()
    quiet = {name: jnp.float32(0) for name in ("k_pv", "k_qv", "k_rr")}
    still = params.vehicle.constants.replace(
        **quiet, i_xx=jnp.float32(1), i_yy=jnp.float32(1), i_zz=jnp.float32(1)
    )
    params = params.replace(reward=weights(**kept), vehicle=params.vehicle.replace(constants=still))
    rows[:, ref.RATES] = [1.0, 1.0, 0.5]
    pitch = np.array([0.0, 0.3, -0.3])
    rows[:, ref.EULER.start + 1] = pitch - 0.01  # it rises by so much within the step
    _, value, outcome = step((environment, params), rows)
    assert outcome.passed[1] and outcome.crashes[HIT_A_GATE][2]
    np.testing.assert_allclose(value, expected, atol=2e-5)


def test_default_reward_is_the_published_one():
    reward = make_race()[1].reward
    values = {name: getattr(reward, name) for name in REWARDS}
    unused = {name for name, x in values.items() if x is None}
    assert unused == {"action_change", "distance"}
    assert {name: float(x) for name, x in values.items() if x} == {
        "progress": 1.0,
        "gate": 10.0,
        "gate_offset": 10.0,
        "collision": 10.0,
        "overspeed": 20.0,  # of a race with a speed limit
    }


def test_gates_may_be_wider_in_training_with_a_penalty():
    wide = make_race(
        "training_limits.gate_inflation=0.3", "reward.gate_edge=20", "reward.gate_edge_margin=0.05"
    )
    beyond = np.array([0.4, 0.7, 0.85])
    points = np.stack([through(1, -0.02, right) for right in beyond])
    rows = level(points, np.tile(5 * normal(1), (3, 1)))
    _, paid, outcome = step(wide, rows, 1)
    assert outcome.passed.tolist() == [True, True, False]
    assert outcome.crashes[HIT_A_GATE].tolist() == [False, False, True]
    passing = 10 - 10 * np.hypot(beyond, 0.03) - 20 * np.maximum(beyond - 0.45, 0)
    expected = [*passing[:2], -10 - 20 * 0.4]
    np.testing.assert_allclose(paid, expected, atol=1e-4)
    outcome = step((wide[0], without_training_limits(wide[0].model, wide[1])), rows, 1)[2]
    assert outcome.crashes[HIT_A_GATE].tolist() == [False, True, True]


def test_flying_near_the_speed_limit_has_a_penalty():
    """A multiple of the reward for progress, above a part of the limit; its gradient is smooth."""
    plain, race = make_race(), ruled(rules__speed_limit=8)
    rows = level(through(0, -2.0), [[5.8, 0, 0], [0, 7, 0]])
    states, value, _ = step(race, rows)
    speed = np.linalg.norm([*states.drone.velocity], axis=0)
    assert speed[0] < 6.0 < speed[1] < 8.0
    expected = 5.0 * 1.0 * 0.01 * np.maximum(speed - 6.0, 0.0)
    np.testing.assert_allclose(step(plain, rows)[1] - value, expected, atol=1e-5)
    params = race[1].replace(reward=race[1].reward.replace(progress=np.float32(2.0)))
    drone = state_of("motor", np.zeros(22, np.float32))

    def penalty(speed):
        after = drone.replace(velocity=Vec3(speed, 0.0 * speed, 0.0 * speed))
        return -5.0 * rewards.overspeed(Step(MODEL, params, None, None, after))

    slope = jax.jit(jax.vmap(jax.grad(penalty)))
    np.testing.assert_allclose(slope(np.float32([5.9, 6.1, -6.1])), [0.0, 10.0, -10.0], atol=1e-4)
