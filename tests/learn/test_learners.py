"""PPO and SHAC on probes whose answer is known, and what a run promises."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.learn import parallel
from quadjax.learn.loop import NonFiniteError, check_finite
from tests.learn.probes import observations, probe
from tests.learn.support import UPDATES, Run, make, plain

BOTH = pytest.mark.parametrize("name", ["ppo", "shac"])
SCALE = {"ppo": 1.0, "shac": 0.5}  # of the rewards that the value sees


@BOTH
def test_constant_reward(name):
    run = Run(name, probe(constant=1.0))
    run.train(20)
    assert run.value(observations()) / SCALE[name] == pytest.approx(1.0, abs=0.05)


@BOTH
def test_truncated_episodes_have_a_future(name):
    """Each step pays one and is cut short: the value is 1 + 1/2 + 1/4 .. = 2."""
    run = Run(name, probe(constant=1.0, truncates=1.0))
    run.train(25)
    assert run.value(observations()) / SCALE[name] == pytest.approx(2.0, abs=0.1)


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
    """The place pays at the end of the step after: act against it."""
    run = Run(name, probe(place=1.0, move=1.0, length=2.0))
    before = run.train(1)["reward"].mean()
    after = run.train(29)["reward"].mean()
    assert run.mean(observations(1.0, 0.0, 0.5)) == pytest.approx(-0.5, abs=0.15)
    assert after > before + 0.1


@BOTH
def test_the_same_on_any_number_of_devices(name):
    def trained(devices):
        run = Run(name, probe(place=1.0, move=0.5, length=3.0, shown=0.3), devices=devices)
        run.train(10 // UPDATES)
        return run.state

    alone = trained(1)
    for devices in (2, 4, 8):
        state = trained(devices)
        assert len(state.environment.place.sharding.device_set) == devices
        for found, wanted in zip(plain(state.params), plain(alone.params), strict=True):
            np.testing.assert_allclose(found, wanted, atol=2e-4)
        np.testing.assert_array_equal(plain(state.keys)[0], plain(alone.keys)[0])
        np.testing.assert_allclose(state.environment.place, alone.environment.place, atol=2e-4)
        np.testing.assert_array_equal(state.environment.sign, alone.environment.sign)


@BOTH
def test_resumed_is_the_same_bit_for_bit(name):
    params = probe(place=1.0, move=0.5, length=3.0)
    learner, mesh = make(name), parallel.make_mesh(2)
    begin = jax.jit(learner.init)(params, jax.random.key(3))
    kept = plain(begin)
    chunk = parallel.compile_chunk(learner, mesh, 3, params, parallel.place(begin, mesh))

    def restored(leaves):
        """A state made of NumPy arrays, as from a file."""
        like, shape = jax.tree.flatten(begin)
        made = [
            jax.random.wrap_key_data(jnp.asarray(x))
            if jnp.issubdtype(y.dtype, jax.dtypes.prng_key)
            else jnp.asarray(x)
            for x, y in zip(leaves, like, strict=True)
        ]
        return parallel.place(jax.tree.unflatten(shape, made), mesh)

    def straight():
        state = restored(kept)
        for _ in range(4):
            state, metrics = chunk(params, state)
        return plain(state), metrics

    def stopped():
        state, _ = chunk(params, restored(kept))
        state, _ = chunk(params, restored(plain(state)))
        state, _ = chunk(params, restored(plain(state)))
        state, metrics = chunk(params, restored(plain(state)))
        return plain(state), metrics

    (one, first), (two, second) = straight(), stopped()
    for found, wanted in zip(two, one, strict=True):
        np.testing.assert_array_equal(found, wanted)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert any(np.any(x != y) for x, y in zip(kept, one, strict=True))


@BOTH
def test_a_chunk_never_compiles_again(name, caplog):
    params = probe(best=1.0)
    learner, mesh = make(name), parallel.make_mesh(2)
    state = parallel.place(jax.jit(learner.init)(params, jax.random.key(0)), mesh)
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        chunk = parallel.compile_chunk(learner, mesh, 3, params, state)
        compiled = [r for r in caplog.records if "Finished XLA compilation" in r.getMessage()]
        caplog.clear()
        for weight in (1.0, 2.0, 3.0):
            state, metrics = chunk(probe(best=weight), state)
        again = [
            r for r in caplog.records if "Finished XLA compilation of jit(many)" in r.getMessage()
        ]
    assert len(compiled) == 1 and not again
    assert int(state.update) == 9 and all(x.shape == (3,) for x in metrics.values())


def changed(before, after):
    return any(np.any(x != y) for x, y in zip(plain(before), plain(after), strict=True))


def test_a_batch_beyond_the_kl_limit_changes_nothing():
    run = Run("ppo", probe(best=1.0), kl_limit=-1.0)
    begin = run.state
    metrics = run.train(1)
    assert np.all(metrics["skipped"] == 1)
    assert not changed((begin.params, begin.optimiser), (run.state.params, run.state.optimiser))
    assert changed(begin.keys, run.state.keys)


def test_the_kl_limit_skips_some_batches_and_not_all():
    run = Run("ppo", probe(best=1.0), kl_limit=1e-3, learning_rate=0.05)
    begin = run.state
    metrics = run.train(1)
    assert 0 < metrics["skipped"].mean() < 1
    assert changed(begin.params, run.state.params)


@BOTH
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_changes_no_parameter(name, bad):
    run = Run(name, probe(best=1.0))
    run.train(1)
    before = run.state
    run.params = probe(best=bad)
    metrics = run.train(1)
    assert not changed(
        (before.params.policy, before.params.value),
        (run.state.params.policy, run.state.params.value),
    )
    assert not changed(before.optimiser, run.state.optimiser)
    assert np.all(metrics["skipped"] == 1)
    with pytest.raises(NonFiniteError, match="update 6"):
        check_finite(metrics, UPDATES)


def test_schedules_reach_their_end_points():
    run = Run("ppo", probe(best=1.0), whole=UPDATES, learning_rate=0.02, final_learning_rate=0.01)
    rate = run.train(1)["learning_rate"]
    np.testing.assert_allclose(rate, np.linspace(0.02, 0.01, UPDATES + 1)[:-1], rtol=1e-5)
    np.testing.assert_allclose(run.train(1)["learning_rate"], 0.01, rtol=1e-5)
    run = Run("shac", probe(best=1.0), whole=UPDATES, std=0.4, final_std=0.2)
    metrics = run.train(1)
    np.testing.assert_allclose(metrics["std"], np.linspace(0.4, 0.2, UPDATES + 1)[:-1], rtol=1e-5)
    np.testing.assert_allclose(metrics["learning_rate"][0], 1e-2, rtol=1e-5)
    metrics = run.train(1)
    np.testing.assert_allclose(metrics["std"], 0.2, rtol=1e-5)
    np.testing.assert_allclose(metrics["learning_rate"], 1e-3, rtol=1e-5)
    np.testing.assert_allclose(np.exp(run.state.params.log_std), 0.2, rtol=1e-5)


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
