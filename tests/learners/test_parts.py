"""The pieces of the learners against loops written out by hand."""

import jax
import numpy as np
import pytest
import scipy.stats
from flax import linen as nn

from quadjax.config.assembly import make_environment
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.learners.loop import plan_chunks
from quadjax.learners.networks import ActorCritic
from quadjax.learners.parallel import choose_devices, core_count, prepare_devices
from quadjax.learners.ppo import PPO, Batch
from quadjax.learners.rollout import Trajectory, clip, first_state, run_epochs, td_lambda
from quadjax.learners.shac import SHAC
from quadjax.learners.state import Task
from quadjax.training.build import training_environment
from tests.learners.probes import ENVIRONMENT, NETWORK, probe

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


def test_a_step_of_muon_moves_all_directions_of_a_matrix_equally_far():
    """The second step, against momentum and SVD in float64; a bias moves as by NAdam."""
    draw, rate, beta = np.random.default_rng(0), 0.01, 0.9
    shapes = {"wide": (8, 20), "tall": (20, 8), "bias": (20,)}
    gradients = [{name: draw.normal(size=shape) for name, shape in shapes.items()} for _ in "12"]
    optimizer = SHAC(optimizer="muon", adam_b1=0.7, adam_b2=0.95).make_policy_optimizer(rate)
    first, second = (jax.tree.map(np.float32, gradient) for gradient in gradients)
    _, state = optimizer.update(first, optimizer.init(first), first)
    step, _ = optimizer.update(second, state, first)
    for name in ("wide", "tall"):
        old, new = (gradient[name] for gradient in gradients)
        momentum = beta * (1 - beta) * old + (1 - beta) * new
        ahead = beta * momentum / (1 - beta**3) + (1 - beta) * new / (1 - beta**2)  # Nesterov
        left, _, right = np.linalg.svd(ahead, full_matrices=False)
        moved = np.einsum("ji,jk,ik->i", left, np.asarray(step[name]), right)
        wanted = -rate * 0.8 * np.sqrt(20.0)
        np.testing.assert_allclose(moved, wanted, rtol=0.35)  # five steps of Newton and Schulz
        np.testing.assert_allclose(step[name], left @ np.diag(moved) @ right, atol=1e-5)
    old, new = (gradient["bias"] for gradient in gradients)
    mean, square = 0.7 * 0.3 * old + 0.3 * new, 0.95 * 0.05 * old**2 + 0.05 * new**2
    ahead = 0.7 * mean / (1 - 0.7**3) + 0.3 * new / (1 - 0.7**2)
    wanted = -rate * ahead / np.sqrt(square / (1 - 0.95**2))
    np.testing.assert_allclose(step["bias"], wanted, rtol=1e-4)


def targets(reward, next_value, terminated, truncated, *numbers):
    steps = Trajectory(None, None, reward, next_value, terminated, truncated, None)
    return jax.jit(td_lambda)(steps, *map(np.float32, numbers))


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
    found = targets(reward, next_value, terminated, truncated, discount, lam)
    wanted = returns(reward, next_value, terminated, truncated, discount, lam)
    np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_the_return_of_short_horizons(steps):
    """What SHAC maximizes: discounting starts again after an end, values follow truncations."""
    reward, _, next_value, terminated, truncated = steps
    hyper = SHAC(discount=0.9, reward_scale=0.5)
    found = hyper.total_return(
        Trajectory(None, None, reward, next_value, terminated, truncated, None)
    )
    expected = 0.0
    for n in range(COUNT):
        gamma = 1.0
        for t in range(TIME):
            expected += gamma * 0.5 * reward[t, n]
            ended = terminated[t, n] or truncated[t, n]
            if truncated[t, n] or (t == TIME - 1 and not ended):
                expected += gamma * 0.9 * next_value[t, n]
            gamma = 1.0 if ended else 0.9 * gamma
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_states_that_episodes_restart_from_are_drawn_every_50_steps():
    """In episodes of one step, of which an environment begins each at the same place."""
    hyper, n = PPO(num_envs=8, rollout_length=150), 8
    task = Task.of(ENVIRONMENT, NETWORK, probe(move=1.0))

    @jax.jit
    def places(key):
        state = first_state(task, key, n, np.float32(0.0))
        return hyper.collect(task, state, key)[1][0].observation[..., 2]

    drawn = np.asarray(places(jax.random.key(0)))[1:].T  # the first is of the state itself
    for one in drawn:
        changes = np.flatnonzero(np.diff(one)) + 2  # steps whose state is another one
        np.testing.assert_array_equal(changes, [51, 101])
    assert len(np.unique(drawn)) == 3 * n


class Proportional(ActorCritic):
    """The observation times one number, as the mean action; its first entry times one, as value."""

    def setup(self):
        self.numbers = [self.param(name, nn.initializers.zeros, ()) for name in ("actor", "critic")]

    def mean(self, observation):
        return self.numbers[0] * observation

    def value(self, observation):
        return self.numbers[1] * observation[:, 0]


def test_the_loss_of_a_minibatch_follows_its_equation():
    """In float64, with ratios on both sides of the clip range and advantages of both signs."""
    draw = np.random.default_rng(1)
    observation, noise = draw.normal(size=(2, 200, 2))
    old, advantage, target = draw.normal(size=(3, 200))
    action, log_std = observation + noise, np.array([-0.3, 0.2])
    std, hyper = np.exp(log_std), PPO(clip_range=0.2, entropy_coefficient=0.01)
    now = scipy.stats.norm.logpdf(action, 0.9 * observation, std).sum(axis=1)
    old = now + 0.5 * old  # of the policy that sampled the actions
    params = {"actor": np.float32(0.9), "log_std": np.float32(log_std), "critic": np.float32(0.5)}
    batch = Batch(*map(np.float32, (observation, action, old, advantage, target)))
    total, _ = hyper.loss(params, Proportional(2), batch)
    ratio = np.exp(now - old)
    scaled = (advantage - advantage.mean()) / advantage.std()
    clipped = np.clip(ratio, 0.8, 1.2)
    assert (ratio > 1.2).any() and (ratio < 0.8).any()
    policy_loss = -np.minimum(ratio * scaled, clipped * scaled).mean()
    value_loss = ((0.5 * observation[:, 0] - target) ** 2).mean()
    entropy = scipy.stats.norm.entropy(scale=std).sum()
    expected = policy_loss + hyper.value_coefficient * value_loss - 0.01 * entropy
    np.testing.assert_allclose(total, expected, rtol=1e-5)


def test_a_gradient_is_scaled_to_a_norm():
    tree = {"a": np.array([3.0], np.float32), "b": np.array([[0.0, 4.0]], np.float32)}
    assert jax.jit(clip)(tree, np.float32(6.0))["a"] == 3
    half = jax.jit(clip)(tree, np.float32(2.5))
    assert half["a"] == 1.5 and half["b"][0, 1] == 2


def test_devices_divide_the_environments():
    assert [choose_devices("auto", n) for n in (0, 1)] == [1, 1]
    assert choose_devices("auto", 64) == min(2 ** int(np.log2(jax.device_count())), 64)
    with pytest.raises(InputError, match="run.devices is 1000, allowed: at most"):
        choose_devices(1000, 64)


@pytest.mark.parametrize("length", [12, 4])
def test_minibatches_take_every_block_once_in_each_epoch(length):
    time, n, minibatches, epochs = 12, 6, 3, 2
    steps = np.arange(time * n * 5.0, dtype=np.float32).reshape(time, n, 5)

    def taken(key):
        def step(carry, rows):
            return carry + 1, {"rows": rows}

        return run_epochs(step, 0, steps, key, epochs, minibatches, length)

    count, metrics = jax.jit(taken)(jax.random.key(0))
    rows = np.asarray(metrics["rows"])
    assert count == epochs * minibatches
    assert rows.shape == (epochs, minibatches, time * n // minibatches, 5)
    for epoch in rows:
        assert sorted(epoch[..., 0].ravel().tolist()) == sorted(steps[..., 0].ravel().tolist())
        for batch in epoch:  # a block stays together, in order
            blocks = batch[:, 0].reshape(-1, length)
            assert np.all(np.diff(blocks, axis=1) == n * 5)
    assert np.any(rows[0] != rows[1])


def test_a_run_has_the_steps_that_are_asked_for():
    for wanted, chunk in np.ndindex(300, 40):
        plan = plan_chunks(10 * (wanted + 1), 10 * (chunk + 1), 10)
        assert wanted < plan.updates <= wanted + plan.updates_per_chunk
    plan = plan_chunks(16_000_000, 250_000, 12288)  # as a preset plans it
    assert (plan.updates_per_chunk, plan.chunks, plan.steps) == (21, 63, 21 * 63 * 12288)


def test_equal_environments_share_their_updates():
    environment, other = (
        training_environment(load_config("e2e_race_robust", [x]))
        for x in ("seed=1", "track=figure8")
    )
    assert environment == other and hash(environment) == hash(other)
    tasks = [Task.of(x, NETWORK, ()) for x in (environment, other)]
    assert jax.tree.structure(tasks[0]) == jax.tree.structure(tasks[1])


@pytest.mark.parametrize(
    "word",
    [
        "vehicle.model=tests.race.test_extensions:LIMITED",
        "observation.extra=[tests.race.test_extensions:HEIGHT]",
        "reward.terms={tests.race.test_extensions:height: 1.0}",
        "rules.extra=[tests.race.test_extensions:ceiling]",
        "network.module=tests.learners.test_train:Constants",
    ],
)
def test_an_environment_with_code_of_the_user_is_shared_by_nothing(word):
    config = load_config("e2e", [word])
    assert make_environment(config) != make_environment(config)


def test_as_many_devices_as_cores_are_prepared_at_most(monkeypatch):
    asked = []
    monkeypatch.setattr(jax.config, "update", lambda _, count: asked.append(count))
    for wanted in (1, "all", 4096):
        prepare_devices(wanted)
    assert asked == [1, core_count(), core_count()]
