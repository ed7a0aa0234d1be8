"""The race as Gymnasium sees it."""

import functools
import multiprocessing
import os
import subprocess
import sys
import warnings

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError

gymnasium = pytest.importorskip("gymnasium", reason="the extra gym is not installed")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AsyncVectorEnv, AutoresetMode  # noqa: E402

from quadjax.integrations.gym import ID, RaceEnv, RaceVectorEnv  # noqa: E402
from tests.race.support import BLANK  # noqa: E402

N = 6
REST = ["start.position=0", "start.velocity=0", "start.roll_pitch_deg=0"]


@functools.cache
def short():
    """A race of episodes of five steps."""
    environment, params = make_race(load_config(BLANK, REST))
    return environment, params.replace(
        training_limits=params.training_limits.replace(episode_steps=np.int32(5))
    )


@functools.cache
def vector(mode: str) -> RaceVectorEnv:
    """The race of five steps with N drones, compiled once for all tests."""
    return RaceVectorEnv(*short(), N, mode)


def hover(n: int = N) -> np.ndarray:
    return np.zeros((n, 4), np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_gymnasiums_own_checker_passes(kind):
    config = load_config(BLANK, [f"vehicle.model={kind}"])
    env = gymnasium.make(ID, config=config, disable_env_checker=True).unwrapped
    assert isinstance(env, RaceEnv)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Observations have no bounds, and there is nothing to render. Other processes may use the
        # compilation cache.
        warnings.filterwarnings("ignore", message=".*(infinity|unlimited|render|cache).*")
        check_env(env)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_vector_is_made_by_its_id(mode):
    config = load_config(BLANK)
    env = gymnasium.make_vec(ID, num_envs=N, config=config, autoreset_mode=mode).unwrapped
    assert isinstance(env, RaceVectorEnv) and env.metadata["autoreset_mode"] == mode


def test_spaces_shapes_and_seeds():
    env = vector("NextStep")
    observation, infos = env.reset(seed=3)
    assert observation in env.observation_space and observation.shape == (N, 24) and infos == {}
    assert env.action_space.contains(hover())
    for value, dtype in zip(env.step(hover()), ("f4", "f8", "?", "?"), strict=False):
        assert value.dtype == np.dtype(dtype) and len(value) == N
    np.testing.assert_array_equal(observation, env.reset(seed=3)[0])
    assert not np.array_equal(observation, env.reset()[0])


def test_unseeded_environments_start_apart():
    """A vector, single races of a vector, and the same vector made again; seeds repeat."""
    singles = gymnasium.vector.SyncVectorEnv([lambda: RaceEnv(*short())] * 3)
    rows = [singles.reset()[0], *(RaceVectorEnv(*short(), 3).reset()[0] for _ in range(2))]
    every = np.concatenate(rows)
    assert len(np.unique(every, axis=0)) == len(every) == 9
    seeded = [RaceVectorEnv(*short(), 3, seed=5).reset()[0] for _ in range(2)]
    seeded.append(RaceVectorEnv(*short(), 3).reset(seed=5)[0])
    np.testing.assert_array_equal(seeded[0], seeded[1])
    np.testing.assert_array_equal(seeded[0], seeded[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render_mode": "human"}, "render_mode is 'human', allowed: None"),
        ({"render_mode": "rgb_array"}, "render_mode is 'rgb_array', allowed: None"),
        ({"num_envs": 0}, "num_envs is 0, allowed: an integer, 1 to"),
        ({"num_envs": 2.0}, "num_envs is 2.0, allowed: an integer, 1 to"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render:UserWarning")
def test_options_that_there_are_not(options, message):
    makers = [gymnasium.make_vec] if "num_envs" in options else [gymnasium.make, gymnasium.make_vec]
    for make in makers:
        with pytest.raises(InputError, match=message):
            make(ID, config=load_config(BLANK), **options)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_a_process_forked_after_jax_started_says_what_to_use():
    """Its first computation would wait forever; a fork before has no such limit."""
    drones = AsyncVectorEnv([lambda: RaceEnv(*short())] * 2, context="fork")
    try:
        drones.reset_async(seed=0)
        with pytest.raises(InputError, match=r"make_vec\(.quadjax/Race-v0.*context='spawn'"):
            drones.reset_wait(timeout=60)
    finally:
        drones.close(terminate=True)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        begun = pool.apply_async(enable_compilation_cache)  # by train, evaluate, export, fit, sil
        with pytest.raises(InputError, match="forked after JAX had started"):
            begun.get(timeout=60)
    code = "import os, quadjax.core.forks as f; os.fork(); f.refuse_forked(); os.write(1, b'ok\\n')"
    other = "import jax, sys, types; sys.modules['jax._src.xla_bridge'] = types.ModuleType('b'); "
    for version, count in (("", 2), (other, 1)):  # of JAX: one that does not tell if it has started
        command = [sys.executable, "-c", version + code]
        alone = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert alone.stdout.split() == ["ok"] * count, alone.stderr


def test_a_truncation_is_no_crash_and_shows_where_it_ended():
    """The final observation is the step's own, before the reset: it equals the race's."""
    same, off = vector("SameStep"), vector("Disabled")
    same.reset(seed=1)
    off.reset(seed=1)
    for step in range(5):
        found, reference = same.step(hover()), off.step(hover())
        np.testing.assert_allclose(found[1], reference[1], atol=1e-6)
        assert found[3].all() == (step == 4) and not found[2].any()
        if step < 4:
            assert "final_obs" not in found[4]
            np.testing.assert_allclose(found[0], reference[0], atol=1e-6)
    infos = found[4]
    assert infos["_final_obs"].all() and infos["_final_info"].all()
    np.testing.assert_allclose(np.stack(infos["final_obs"]), reference[0], atol=1e-6)
    assert np.abs(found[0] - reference[0]).max() > 0.01  # the next episode has begun
    with pytest.raises(RuntimeError, match="reset_mask"):
        off.step(hover())
    mask = np.arange(N) < 2
    begun, _ = off.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(begun[~mask], reference[0][~mask])
    assert np.abs(begun[mask] - reference[0][mask]).max() > 0.01


def test_a_crash_is_no_truncation():
    """Every start is beyond the limit of the position."""
    environment, params = short()
    params = params.replace(rules=params.rules.replace(position_limit=np.float32(0.01)))
    env = RaceVectorEnv(environment, params, N, "SameStep")
    env.reset(seed=0)
    _, reward, terminated, truncated, infos = env.step(hover())
    assert terminated.any() and not truncated.any()
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    assert all((x is not None) == t for x, t in zip(infos["final_obs"], terminated, strict=True))
    np.testing.assert_allclose(reward[terminated], -10.0)


def test_the_next_episode_begins_a_step_later_where_asked():
    env = vector("NextStep")
    env.reset(seed=1)
    for _ in range(5):
        ended = env.step(hover())
    assert (ended[2] | ended[3]).all() and "final_obs" not in ended[4]
    begun, reward, terminated, truncated, _ = env.step(hover())
    assert not reward.any() and not terminated.any() and not truncated.any()
    assert np.abs(begun - ended[0]).max() > 0.01
    following = env.step(hover())
    assert (np.abs(following[0] - begun).max(axis=1) > 1e-3).all()  # the motors have run up


@pytest.mark.slow
def test_a_single_race_does_not_restart_by_itself():
    env = RaceEnv(*short())
    env.reset(seed=1)
    for _ in range(5):
        *_, terminated, truncated, _ = env.step(hover(1)[0])
        if terminated or truncated:
            break
    assert terminated or truncated
    with pytest.raises(RuntimeError, match="an episode is over: call reset"):
        env.step(hover(1)[0])
    begun, _ = env.reset()
    assert np.abs(env.step(hover(1)[0])[0] - begun).max() > 1e-3  # the motors have run up


def test_it_is_the_race_that_is_trained():
    """The same rewards as the learners' environment, step for step."""
    env = vector("Disabled")
    env.reset(seed=2)
    race, params = short()
    state = jax.tree.map(lambda x: np.asarray(x)[..., 0], jax.device_get(env._batch.state))
    action = np.array([0.1, -0.2, 0.3, 0.0], np.float32)

    @jax.jit
    def step(params, state, action):
        following, reward, _, _ = race.step(params, state, action)
        return race.observe(params, following), reward

    observation, reward = step(params, state, action)
    found = env.step(np.tile(action, (N, 1)))
    np.testing.assert_allclose(found[1][0], reward, atol=1e-6)
    np.testing.assert_allclose(found[0][0], observation, atol=1e-5)


@pytest.mark.slow
def test_stable_baselines_sees_how_an_episode_ended():
    """Its own view: one key for both ends of an episode, the last observation beside it."""
    pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")
    from quadjax.integrations.sb3 import RaceVecEnv

    env = RaceVecEnv(*short(), N, seed=0)
    env.reset()
    for _ in range(5):
        observation, _, done, infos = env.step(hover())
    assert done.any() and observation.shape == (N, 24)
    for flag, info in zip(done, infos, strict=True):
        assert flag == ("terminal_observation" in info)
    assert any(info.get("TimeLimit.truncated") for info in infos)
