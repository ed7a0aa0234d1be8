"""The pieces of the learners against loops written out by hand."""

import chex
import jax
import numpy as np
import pytest
import scipy.stats

from quadjax.learners import shards
from quadjax.learners.loop import plan_chunks
from quadjax.learners.minibatches import shuffled, take_rows, to_blocks
from quadjax.learners.optimization import clip_by_norm
from quadjax.learners.ppo.advantage import advantages
from quadjax.learners.ppo.loss import normalize
from quadjax.learners.ppo.rollout import log_probability, reset_interval
from quadjax.learners.shac.rollout import Trajectory
from quadjax.learners.shac.targets import td_lambda_targets
from quadjax.learners.sharding import device_count
from quadjax.learners.state import AXIS

TIME, COUNT = 30, 7


@pytest.fixture(scope="module")
def steps():
    """Random steps with a few ends of both kinds."""
    draw = np.random.default_rng(0)
    numbers = draw.normal(size=(3, TIME, COUNT)).astype(np.float32)
    kind = draw.uniform(size=(TIME, COUNT))
    terminated, truncated = kind < 0.1, (kind > 0.1) & (kind < 0.25)
    assert terminated.sum() > 5 and truncated.sum() > 5
    return (*numbers, terminated, truncated)


def gae(reward, value, next_value, terminated, truncated, discount, lam):
    """For every step, sum the discounted errors ahead until the episode ends."""
    result = np.zeros_like(reward)
    for n in range(reward.shape[1]):
        for t in range(len(reward)):
            weight = 1.0
            for k in range(t, len(reward)):
                ahead = 0.0 if terminated[k, n] else next_value[k, n]
                result[t, n] += weight * (reward[k, n] + discount * ahead - value[k, n])
                if terminated[k, n] or truncated[k, n]:
                    break
                weight *= discount * lam
    return result


@pytest.mark.parametrize(("discount", "lam"), [(0.99, 0.95), (0.9, 0.0), (1.0, 1.0)])
def test_advantages(steps, discount, lam):
    found = jax.jit(advantages)(*steps, np.float32(discount), np.float32(lam))
    np.testing.assert_allclose(found, gae(*steps, discount, lam), atol=2e-5)


def returns(reward, next_value, terminated, truncated, discount, lam):
    """The mixture of n-step returns, each written out."""
    result = np.zeros_like(reward)
    for n in range(reward.shape[1]):
        for t in range(len(reward)):
            total, weight, gamma = 0.0, 1.0, 1.0
            for k in range(t, len(reward)):
                total += weight * gamma * reward[k, n]
                gamma *= discount
                if terminated[k, n]:
                    break
                if truncated[k, n] or k == len(reward) - 1:
                    total += weight * gamma * next_value[k, n]
                    break
                total += weight * (1 - lam) * gamma * next_value[k, n]
                weight *= lam
            result[t, n] = total
    return result


@pytest.mark.parametrize(("discount", "lam"), [(0.99, 0.95), (0.9, 0.0), (0.95, 1.0)])
def test_td_lambda_targets(steps, discount, lam):
    reward, _, next_value, terminated, truncated = steps
    trajectory = Trajectory(np.zeros((TIME, COUNT, 1), np.float32), reward, next_value, *steps[3:])
    found = jax.jit(td_lambda_targets)(trajectory, np.float32(discount), np.float32(lam))
    wanted = returns(reward, next_value, terminated, truncated, discount, lam)
    np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_log_probability():
    draw = np.random.default_rng(1)
    action, mean = draw.normal(size=(2, 5, 6, 4)).astype(np.float32)
    log_std = np.array([-1.0, 0.0, 0.5, -0.3], np.float32)
    wanted = scipy.stats.norm(mean, np.exp(log_std)).logpdf(action).sum(axis=-1)
    found = jax.jit(log_probability)(action, mean, log_std)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)


def test_advantages_are_normalized_over_all_devices():
    values = np.random.default_rng(2).normal(3.0, 5.0, (4, 100)).astype(np.float32)
    found = jax.jit(jax.vmap(normalize, axis_name=AXIS))(values)
    np.testing.assert_allclose(found, (values - values.mean()) / values.std(), atol=1e-4)


def test_clip_by_norm():
    clip = jax.jit(clip_by_norm)
    tree = {"a": np.array([3.0], np.float32), "b": np.array([[0.0, 4.0]], np.float32)}
    same, norm = clip(tree, np.float32(6.0))
    assert norm == 5 and same["a"] == 3
    half, norm = clip(tree, np.float32(2.5))
    assert norm == 5 and half["a"] == 1.5 and half["b"][0, 1] == 2
    still, _ = clip(jax.tree.map(np.zeros_like, tree), np.float32(1.0))
    np.testing.assert_array_equal(still["b"], 0.0)


@pytest.mark.parametrize(
    ("num_envs", "blocks", "minibatches", "count"),
    [(64, 1, 1, 8), (12, 1, 1, 4), (7, 1, 1, 1), (16, 1, 8, 2), (16, 2, 8, 4), (100, 10, 200, 1)],
)
def test_count_shards(num_envs, blocks, minibatches, count):
    assert shards.count_shards(num_envs, blocks, minibatches) == count


def test_device_count():
    assert [device_count(8, wanted) for wanted in (0, 1, 2, 3, 8, 20)] == [1, 1, 2, 2, 8, 8]


def test_reset_interval():
    assert [reset_interval(n) for n in (1, 8, 64, 128, 100, 67)] == [1, 8, 64, 64, 50, 1]


def test_where_done_of_states_of_any_shape():
    done = np.array([True, False])
    fresh, old = ({"a": each(2), "b": each((3, 2))} for each in (np.ones, np.zeros))
    found = jax.jit(shards.where_done)(done, fresh, old)
    np.testing.assert_array_equal(found["a"], [1, 0])
    np.testing.assert_array_equal(found["b"], [[1, 0]] * 3)


def test_noise_of_a_shard_does_not_depend_on_the_others():
    keys = jax.random.split(jax.random.key(0), 4)
    draw = jax.jit(lambda keys: shards.normal_all(keys, (5,), 3, 2))
    every = np.asarray(draw(keys))
    assert every.shape == (5, 12, 2)
    np.testing.assert_array_equal(draw(keys[1:2]), every[:, 3:6])
    assert abs(every.mean()) < 0.3 and abs(every.std() - 1) < 0.2


def test_minibatches_take_every_block_of_every_shard_once():
    count, minibatches, length = 2, 3, 4
    steps = np.arange(3 * length * 4.0 * 5, dtype=np.float32).reshape(3 * length, 4, 5)
    blocks = np.asarray(jax.jit(to_blocks, static_argnums=(1, 2))(steps, count, length))
    chex.assert_shape(blocks, (count, 6, length, 5))
    np.testing.assert_array_equal(blocks[1, 4], steps[length : 2 * length, 3])
    keys = jax.random.split(jax.random.key(0), count)
    chosen = np.asarray(jax.jit(shuffled, static_argnums=(1, 2))(keys, 6, minibatches))
    chex.assert_shape(chosen, (minibatches, count, 2))
    take = jax.jit(take_rows)
    rows = np.stack([take(blocks, batch) for batch in chosen])
    chex.assert_shape(rows, (minibatches, count * 2 * length, 5))
    assert sorted(rows[..., 0].ravel().tolist()) == sorted(steps[..., 0].ravel().tolist())
    first = rows[0, :length]  # a block stays together, in order
    chex.assert_trees_all_equal(first, blocks[0, chosen[0, 0, 0]])
    with pytest.raises(AssertionError):
        take_rows(blocks, chosen[0, :1])


@pytest.mark.parametrize(
    ("steps", "chunk", "update", "expected"),
    [
        (1000, 100, 10, (10, 10)),
        (50, 100, 10, (5, 1)),
        (3, 100, 10, (1, 1)),
        (1000, 3, 7, (1, 143)),
        (1_490_000, 1_000_000, 1000, (1490, 1)),
        (3_400_000, 1_000_000, 1000, (1133, 3)),
        (16_000_000, 250_000, 12288, (20, 65)),  # as a preset plans it
    ],
)
def test_plan_chunks(steps, chunk, update, expected):
    plan = plan_chunks(steps, chunk, update)
    assert (plan.updates_per_chunk, plan.chunks) == expected
    assert plan.steps == expected[0] * expected[1] * update


def test_a_run_has_the_steps_that_are_asked_for():
    for wanted in range(1, 400):
        for chunk in range(1, 60):
            plan = plan_chunks(10 * wanted, 10 * chunk, 10)
            assert abs(plan.updates - wanted) <= plan.chunks / 2
