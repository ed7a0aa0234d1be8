"""PPO and SHAC on probes whose answer is known, and what a run promises."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.learners import parallel
from quadjax.learners.loop import NonFiniteError, check_finite
from quadjax.learners.schedules import Training
from tests.learners.probes import observations, probe
from tests.learners.support import DEFAULTS, UPDATES, Run, plain

BOTH = pytest.mark.parametrize("name", ["ppo", "shac"])
ALL = pytest.mark.parametrize("name", DEFAULTS)
SCALE = {"ppo": 1.0, "shac": 0.5}  # of the rewards that the value sees
VALUES = {  # weights of a probe: the values of (sign, clock), with a discount of one half
    "constant reward": ({"constant": 1.0}, {(1.0, 0.0): 1.0}),
    "reward equals observation": ({"shown": 1.0}, {(1.0, 0.0): 1.0, (-1.0, 0.0): -1.0}),
    "delayed reward": (
        {"last": 1.0, "length": 3.0},
        {(1.0, 0.0): 0.25, (1.0, 1.0): 0.5, (1.0, 2.0): 1.0},
    ),
    "truncated episodes have a future": ({"constant": 1.0, "truncates": 1.0}, {(1.0, 0.0): 2.0}),
}
ACTIONS = {  # weights of a probe: the best actions at (sign, clock, place)
    "best action": ({"best": 1.0}, {(1.0, 0.0, 0.0): 0.5}),
    "action from observation": (
        {"follow": 1.0},
        {(1.0, 0.0, 0.0): 0.5, (-1.0, 0.0, 0.0): -0.5},
    ),
    "action whose reward comes through the state": (
        {"place": 1.0, "move": 1.0, "length": 2.0},
        {(1.0, 0.0, 0.5): -0.5},
    ),
}


@BOTH
@pytest.mark.parametrize("case", VALUES)
def test_the_value_of_a_probe(name, case):
    """The mean of some chunks: the value of SHAC varies by a tenth from one to the next."""
    weights, wanted = VALUES[case]
    run, values = Run(name, probe(**weights)), []
    run.train(20)
    for _ in range(20):
        run.train(1)
        values.append([run.value(observations(*key)) / SCALE[name] for key in wanted])
    np.testing.assert_allclose(np.mean(values, axis=0), list(wanted.values()), atol=0.1)


@ALL
@pytest.mark.parametrize("case", ACTIONS)
def test_the_best_action_of_a_probe(name, case):
    weights, wanted = ACTIONS[case]
    run = Run(name, probe(**weights))
    before, after = run.train(1)["reward"].mean(), run.train(29)["reward"].mean()
    for key, action in wanted.items():
        assert run.mean(observations(*key)) == pytest.approx(action, abs=0.15)
    assert after > before + 0.05


@ALL
@pytest.mark.slow
def test_the_same_on_several_devices(name):
    def trained(devices):
        run = Run(name, probe(place=1.0, move=0.5, length=3.0, shown=0.3), devices=devices)
        chunks = [run.train(1) for _ in range(10 // UPDATES)]
        return run.state, {key: np.concatenate([c[key] for c in chunks]) for key in chunks[0]}

    alone, wanted = trained(1)
    state, found = trained(4)
    for key in ("policy_loss", "value_loss"):
        assert found[key].shape == (10,)
        np.testing.assert_allclose(found[key], wanted[key], rtol=1e-4, atol=1e-5)
    assert len(state.env_states.place.sharding.device_set) == 4
    for here, there in zip(plain(state.params), plain(alone.params), strict=True):
        np.testing.assert_allclose(here, there, atol=2e-4)
    np.testing.assert_array_equal(plain(state.key)[0], plain(alone.key)[0])
    np.testing.assert_allclose(state.env_states.place, alone.env_states.place, atol=2e-4)


@ALL
def test_resumed_is_the_same_bit_for_bit(name):
    """A state made of NumPy arrays, as from a file, trains on as the one in memory."""
    straight, stopped = (Run(name, probe(place=1.0, move=0.5, length=3.0)) for _ in range(2))
    for _ in range(3):
        first, second = straight.train(1), stopped.train(1)
        leaves, shape = jax.tree.flatten(stopped.state)
        made = [
            jax.random.wrap_key_data(x) if jnp.issubdtype(y.dtype, jax.dtypes.prng_key) else x
            for x, y in zip(plain(stopped.state), leaves, strict=True)
        ]
        stopped.state = parallel.place(jax.tree.unflatten(shape, made), parallel.make_mesh(1))
    assert not changed(stopped.state, straight.state)
    chex.assert_trees_all_equal(first, second)


def changed(before, after):
    return any(np.any(x != y) for x, y in zip(plain(before), plain(after), strict=True))


def test_a_batch_beyond_the_kl_limit_changes_nothing():
    run = Run("ppo", probe(best=1.0), max_kl=1e-3, learning_rate=0.05)
    begin = run.state
    assert 0 < run.train(1)["skipped"].mean() < 1  # some batches and not all
    assert changed(begin.params, run.state.params)
    run.change(max_kl=jnp.float32(-1.0))
    begin = run.state
    assert np.all(run.train(1)["skipped"] == 1)
    assert not changed((begin.params, begin.optimizer), (run.state.params, run.state.optimizer))
    assert changed(begin.key, run.state.key)


@ALL
def test_what_is_not_finite_changes_no_parameter(name):
    run = Run(name, probe(best=1.0))
    run.train(1)
    before = run.state
    for bad in (np.nan, np.inf):
        run.change(probe(best=bad))
        metrics = run.train(1)
        for part in ("actor", "critic"):
            assert not changed(before.params[part], run.state.params[part])
        assert not changed(before.optimizer, run.state.optimizer)
        assert np.all(metrics["skipped"] == 1)
        with pytest.raises(NonFiniteError, match="update 6"):
            check_finite(metrics, UPDATES)


@pytest.mark.slow
def test_the_moving_average_follows_the_parameters():
    run = Run("shac", probe(best=1.0))
    update = jax.jit(Training.update, compiler_options={"xla_backend_optimization_level": 0})
    first, _ = update(run.training, run.state)
    for rate, done, expected in ((1.0, 60, 1.0), (0.1, 60, 0.25), (0.1, 0, 1.0), (0.1, 999, 0.1)):
        run.change(ema_rate=jnp.float32(rate))
        found, _ = update(run.training, first.replace(update=jnp.int32(done)))
        for name in ("actor", "critic"):
            three = (plain(x[name]) for x in (first.ema, found.params, found.ema))
            for old, new, average in zip(*three, strict=True):
                wanted = (1 - expected) * old + expected * new
                np.testing.assert_allclose(average, wanted, rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(found.evaluated["log_std"], found.params["log_std"])
        assert changed(found.evaluated["actor"], found.params["actor"]) == (expected < 1)
    assert Run("ppo", probe()).state.ema is None


@pytest.mark.parametrize("name, truncates", [("ppo", 0.0), ("shac", 1.0)])
def test_metrics_count_ends(name, truncates):
    metrics = Run(name, probe(constant=2.0, length=4.0, truncates=truncates)).train(1)
    wanted = {"reward": 2.0, "crash_rate": 1.0 - truncates, "terminated": 0.25 - 0.25 * truncates}
    for key, value in wanted.items():
        np.testing.assert_allclose(metrics[key], value, rtol=1e-5, atol=1e-6)
