"""PPO and SHAC on probes whose answer is known, and what a run promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.learners import parallel
from quadjax.learners.loop import NonFiniteError, check_finite
from tests.learners.probes import observations, probe
from tests.learners.support import UPDATES, Run, make, plain

BOTH = pytest.mark.parametrize("name", ["ppo", "shac"])
SCALE = {"ppo": 1.0, "shac": 0.5}  # of the rewards that the value sees


@BOTH
def test_constant_reward(name):
    run = Run(name, probe(constant=1.0))
    run.train(20)
    assert run.value(observations()) / SCALE[name] == pytest.approx(1.0, abs=0.05)


@BOTH
def test_truncated_episodes_have_a_future(name):
    """The reward is 1 and every step truncates: the value is 1 + 1/2 + 1/4 + ... = 2."""
    run = Run(name, probe(constant=1.0, truncates=1.0))
    run.train(20)
    values = []
    for _ in range(20):  # the value of SHAC varies by a tenth from chunk to chunk
        run.train(1)
        values.append(run.value(observations()) / SCALE[name])
    assert np.mean(values) == pytest.approx(2.0, abs=0.1)


@BOTH
def test_an_update_keeps_every_field_of_the_state(name):
    """Also those that only wrappers of a learner set."""
    learner = make(name)

    def update(key):
        state = learner.init(learner.hyper, probe(), key)
        state = state.replace(level=jnp.float32(0.5))
        return state, learner.update(learner.hyper, probe(), state)[0]

    before, after = jax.eval_shape(update, jax.random.key(0))
    assert jax.tree.structure(after) == jax.tree.structure(before)


@BOTH
def test_reward_equals_observation(name):
    run = Run(name, probe(shown=1.0))
    run.train(20)
    for sign in (1.0, -1.0):
        assert run.value(observations(sign)) / SCALE[name] == pytest.approx(sign, abs=0.1)


@BOTH
def test_delayed_reward(name):
    run = Run(name, probe(last=1.0, length=3.0))
    run.train(25)
    for clock, value in ((0.0, 0.25), (1.0, 0.5), (2.0, 1.0)):
        assert run.value(observations(1.0, clock)) / SCALE[name] == pytest.approx(value, abs=0.08)


@BOTH
def test_best_action(name):
    run = Run(name, probe(best=1.0))
    run.train(25)
    assert run.mean(observations()) == pytest.approx(0.5, abs=0.06)


@BOTH
def test_action_from_observation(name):
    run = Run(name, probe(follow=1.0))
    run.train(30)
    for sign in (1.0, -1.0):
        assert run.mean(observations(sign)) == pytest.approx(0.5 * sign, abs=0.1)


@BOTH
def test_action_whose_reward_comes_through_the_state(name):
    """The penalty on the position makes the best action the opposite of the position."""
    run = Run(name, probe(place=1.0, move=1.0, length=2.0))
    before = run.train(1)["reward"].mean()
    after = run.train(29)["reward"].mean()
    assert run.mean(observations(1.0, 0.0, 0.5)) == pytest.approx(-0.5, abs=0.15)
    assert after > before + 0.1


@BOTH
@pytest.mark.slow
def test_the_same_on_any_number_of_devices(name):
    def trained(devices):
        run = Run(name, probe(place=1.0, move=0.5, length=3.0, shown=0.3), devices=devices)
        chunks = [run.train(1) for _ in range(10 // UPDATES)]
        return run.state, {key: np.concatenate([c[key] for c in chunks]) for key in chunks[0]}

    alone, wanted = trained(1)
    for devices in (2, 4):
        state, found = trained(devices)
        for key in ("policy_loss", "value_loss"):
            assert found[key].shape == (10,)
            np.testing.assert_allclose(found[key], wanted[key], rtol=1e-4, atol=1e-5)
        assert len(state.environment.place.sharding.device_set) == devices
        for here, there in zip(plain(state.params), plain(alone.params), strict=True):
            np.testing.assert_allclose(here, there, atol=2e-4)
        np.testing.assert_array_equal(plain(state.key)[0], plain(alone.key)[0])
        np.testing.assert_allclose(state.environment.place, alone.environment.place, atol=2e-4)
        np.testing.assert_array_equal(state.environment.sign, alone.environment.sign)


@BOTH
def test_resumed_is_the_same_bit_for_bit(name):
    """A state made of NumPy arrays, as from a file, trains on as the one in memory."""
    straight, stopped = (Run(name, probe(place=1.0, move=0.5, length=3.0)) for _ in range(2))
    begin = plain(straight.state)
    for _ in range(3):
        first, second = straight.train(1), stopped.train(1)
        leaves, shape = jax.tree.flatten(stopped.state)
        made = [
            jax.random.wrap_key_data(x) if jnp.issubdtype(y.dtype, jax.dtypes.prng_key) else x
            for x, y in zip(plain(stopped.state), leaves, strict=True)
        ]
        stopped.state = parallel.place(jax.tree.unflatten(shape, made), parallel.make_mesh(1))
    for found, wanted in zip(plain(stopped.state), plain(straight.state), strict=True):
        np.testing.assert_array_equal(found, wanted)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert any(np.any(x != y) for x, y in zip(begin, plain(straight.state), strict=True))


def changed(before, after):
    return any(np.any(x != y) for x, y in zip(plain(before), plain(after), strict=True))


def test_a_batch_beyond_the_kl_limit_changes_nothing():
    run = Run("ppo", probe(best=1.0), max_kl=1e-3, learning_rate=0.05)
    begin = run.state
    assert 0 < run.train(1)["skipped"].mean() < 1  # some batches and not all
    assert changed(begin.params, run.state.params)
    run.hyper = run.hyper.model_copy(update={"max_kl": jnp.float32(-1.0)})
    begin = run.state
    assert np.all(run.train(1)["skipped"] == 1)
    assert not changed((begin.params, begin.optimizer), (run.state.params, run.state.optimizer))
    assert changed(begin.key, run.state.key)


@BOTH
def test_what_is_not_finite_changes_no_parameter(name):
    run = Run(name, probe(best=1.0))
    run.train(1)
    before = run.state
    for bad in (np.nan, np.inf):
        run.params = probe(best=bad)
        metrics = run.train(1)
        assert not changed(
            (before.params.policy, before.params.value),
            (run.state.params.policy, run.state.params.value),
        )
        assert not changed(before.optimizer, run.state.optimizer)
        assert np.all(metrics["skipped"] == 1)
        with pytest.raises(NonFiniteError, match="update 6"):
            check_finite(metrics, UPDATES)


@BOTH
def test_a_policy_stands_still_while_the_value_warms_up(name):
    run = Run(name, probe(best=1.0), update=0)
    begin = run.state.params

    def momentum():
        first = run.state.optimizer[0]  # of the policy alone, or of all parameters
        return jax.tree.map(jnp.copy, first[0].mu if name == "shac" else first.mu.policy)

    resting = momentum()
    run.train(1)
    after = run.state.params
    assert not changed(begin.policy, after.policy) and changed(begin.value, after.value)
    assert changed(resting, momentum()), "Adam learns the gradient's size meanwhile"
    run.train(1)
    assert changed(begin.policy, run.state.params.policy)


@pytest.mark.slow
def test_the_moving_average_follows_the_parameters():
    run = Run("shac", probe(best=1.0), critic_warmup=0)
    quick = {"xla_backend_optimization_level": 0}
    update = jax.jit(run.learner.update, compiler_options=quick)
    first, _ = update(run.hyper, run.params, run.state)
    for rate, done, expected in ((1.0, 60, 1.0), (0.1, 60, 0.25), (0.1, 0, 1.0), (0.1, 999, 0.1)):
        begin = first.replace(update=jnp.int32(done))
        hyper = run.hyper.model_copy(update={"ema_rate": jnp.float32(rate)})
        found, _ = update(hyper, run.params, begin)
        for name in ("policy", "value"):
            old, new, average = (
                plain(getattr(x, name)) for x in (first.ema, found.params, found.ema)
            )
            for a, b, c in zip(old, new, average, strict=True):
                wanted = (1 - expected) * a + expected * b
                np.testing.assert_allclose(c, wanted, rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(found.evaluated.log_std, found.params.log_std)
        assert changed(first.params.policy, found.params.policy)
        assert changed(found.evaluated.policy, found.params.policy) == (expected < 1)
    assert Run("ppo", probe()).state.ema is None


def test_metrics_count_ends():
    run = Run("ppo", probe(constant=2.0, length=4.0))
    metrics = run.train(1)
    np.testing.assert_allclose(metrics["reward"], 2.0, rtol=1e-5)
    np.testing.assert_allclose(metrics["terminated"], 0.25, rtol=1e-5)
    np.testing.assert_allclose(metrics["crash_rate"], 1.0, rtol=1e-5)
    run = Run("shac", probe(constant=2.0, length=4.0, truncates=1.0))
    metrics = run.train(1)
    np.testing.assert_allclose(metrics["reward"], 2.0, rtol=1e-5)
    np.testing.assert_allclose(metrics["crash_rate"], 0.0, atol=1e-6)
