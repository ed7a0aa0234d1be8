"""The race as Gymnasium knows environments: many drones at once, or one.

``RaceVectorEnv`` is a ``gymnasium.vector.VectorEnv`` over the racing environment of a config, one
compiled program for all drones; ``RaceEnv`` is one drone of it, as Gymnasium's checker wants it.
Both are registered as ``quadjax/Race-v0``. Needs the extra ``gym``.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS
from quadjax.learners.shards import where_done
from quadjax.race.build import build_params, choices_of
from quadjax.race.environment import RaceParams, RaceState, make_environment

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError:
    raise InputError(
        "this needs Gymnasium, which is not installed: pip install -e '.[gym]'"
    ) from None

Info = dict[str, np.ndarray]
Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]
ID = "quadjax/Race-v0"
DEFAULT_CONFIG = CONFIGS / "e2e_shac.yaml"


@struct.dataclass
class Drones:
    """All drones between two calls."""

    state: RaceState  # batched along the last axis
    over: jax.Array  # (n,) bool: the episode has ended and is not yet begun anew
    key: jax.Array  # () PRNG key


@struct.dataclass
class Seen:
    """What a step shows."""

    observation: jax.Array  # (n, observation_size), of the next episode where it has begun
    final: jax.Array  # (n, observation_size), of the step itself, before any reset
    reward: jax.Array  # (n,)
    terminated: jax.Array  # (n,) bool
    truncated: jax.Array  # (n,) bool
    gates_passed: jax.Array  # (n,) int32, of the step's episode


def begin_all(
    environment: Environment, n: int, params: RaceParams, key: jax.Array
) -> tuple[RaceState, jax.Array]:
    """Fresh drones and their observations (n, observation_size)."""
    state = jax.vmap(environment.reset, in_axes=(None, 0), out_axes=-1)(
        params, jax.random.split(key, n)
    )
    return state, jax.vmap(environment.observe, in_axes=(None, -1))(params, state)


def step_all(
    environment: Environment,
    mode: AutoresetMode,
    params: RaceParams,
    drones: Drones,
    action: jax.Array,
) -> tuple[Drones, Seen]:
    """One step of every drone, with resets as the mode says.

    ``SAME_STEP`` begins the next episode within the step that ends one; ``NEXT_STEP`` in the step
    after, whose action, reward and flags do not count; ``DISABLED`` leaves it to the caller.
    """
    n = action.shape[0]
    following, reward, terminated, truncated = jax.vmap(
        environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0)
    )(params, drones.state, action)
    observe = jax.vmap(environment.observe, in_axes=(None, -1))
    key, reset_key = jax.random.split(drones.key)
    late = drones.over & (mode == AutoresetMode.NEXT_STEP)
    reward = jnp.where(late, 0.0, reward)
    terminated, truncated = terminated & ~late, truncated & ~late
    done = terminated | truncated
    anew = {
        AutoresetMode.SAME_STEP: done,
        AutoresetMode.NEXT_STEP: late,
        AutoresetMode.DISABLED: jnp.zeros_like(done),
    }[mode]
    begun = jax.lax.cond(
        anew.any(),
        lambda: where_done(anew, begin_all(environment, n, params, reset_key)[0], following),
        lambda: following,
    )
    seen = Seen(
        observation=observe(params, begun),
        final=observe(params, following),
        reward=reward,
        terminated=terminated,
        truncated=truncated,
        gates_passed=jnp.where(late, 0, following.gates_passed),
    )
    return Drones(begun, done, key), seen


class RaceVectorEnv(VectorEnv):
    """The race of a config as a vector environment of ``num_envs`` drones.

    Observations are (num_envs, 24 or 17) float32, actions (num_envs, 4) float32 in [-1, 1]; what
    lies beyond is clipped by the race. ``terminated`` is a crash, ``truncated`` the end of the
    clock; limits, gates' margins and rewards are training's, as the config has them, and what
    ``train`` ramps in during a run is there from the first step.

    Infos: ``gates_passed`` (num_envs,) of the step's episode; with ``SAME_STEP`` also ``final_obs``
    with the observations in which episodes ended, and ``final_info``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        config: Config | Path | str = DEFAULT_CONFIG,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        seed: int = 0,
    ) -> None:
        """Build the race; nothing is compiled yet.

        Args:
            num_envs: drones.
            config: a config, or its YAML file.
            autoreset_mode: when the next episode begins: same step, next step, or disabled.
            seed: of the first ``reset`` that is given none.

        Raises:
            InputError: a config that cannot be read.
        """
        config = config if isinstance(config, Config) else load_config(config)
        mode = AutoresetMode(autoreset_mode)
        environment = make_environment(choices_of(config))
        self.num_envs, self._mode = num_envs, mode
        self.metadata = {"autoreset_mode": mode, "render_modes": []}
        self._params = build_params(config)
        self._begin = jax.jit(functools.partial(begin_all, environment, num_envs))
        self._step = jax.jit(functools.partial(step_all, environment, mode))
        size = environment.observation_size
        self.single_observation_space = _box(np.inf, (size,))
        self.single_action_space = _box(1.0, (environment.action_size,))
        self.observation_space = _box(np.inf, (num_envs, size))
        self.action_space = _box(1.0, (num_envs, environment.action_size))
        self._key = jax.random.key(seed)
        self._drones: Drones | None = None

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin all episodes anew, or those of ``options["reset_mask"]``, (num_envs,) bool."""
        super().reset(seed=seed, options=options)
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, reset_key, key = jax.random.split(self._key, 3)
        state, observation = self._begin(self._params, reset_key)
        mask = (options or {}).get("reset_mask")
        over = np.zeros(self.num_envs, bool)
        if mask is not None and self._drones is not None:
            kept = self._drones
            state = where_done(jnp.asarray(mask, bool), state, kept.state)
            observation = np.where(np.asarray(mask)[:, None], observation, self._last)
            over = np.asarray(kept.over) & ~np.asarray(mask)
        self._drones = Drones(state, jnp.asarray(over), key)
        self._last = np.asarray(observation)
        return self._last.copy(), {}

    def step(self, actions: np.ndarray) -> Step:
        """Fly one step of every drone.

        Raises:
            RuntimeError: before the first ``reset``, or where an episode is over that ``DISABLED``
                left to be reset.
        """
        if self._drones is None:
            raise RuntimeError("reset has to be called before step")
        if self._mode == AutoresetMode.DISABLED and bool(self._drones.over.any()):
            raise RuntimeError("an episode is over: reset it, with options reset_mask")
        actions = jnp.asarray(actions, jnp.float32).reshape(self.action_space.shape)
        self._drones, seen = self._step(self._params, self._drones, actions)
        seen = jax.device_get(seen)
        self._last = np.array(seen.observation)
        reward = seen.reward.astype(np.float64)
        infos = self._infos(seen)
        return self._last.copy(), reward, np.array(seen.terminated), np.array(seen.truncated), infos

    def _infos(self, seen: Seen) -> Info:
        every = np.ones(self.num_envs, bool)
        done = seen.terminated | seen.truncated
        infos = {"gates_passed": np.array(seen.gates_passed), "_gates_passed": every}
        if self._mode == AutoresetMode.SAME_STEP and done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(done):
                final[index] = np.array(seen.final[index])
            last = {"gates_passed": np.array(seen.gates_passed), "_gates_passed": done}
            infos |= {"final_obs": final, "_final_obs": done}
            infos |= {"final_info": last, "_final_info": done}
        return infos


class RaceEnv(gymnasium.Env):
    """One drone's race, as ``gymnasium.Env``; the caller resets it."""

    metadata = {"render_modes": []}

    def __init__(
        self, config: Config | Path | str = DEFAULT_CONFIG, render_mode: None = None
    ) -> None:
        """Build the race of a config."""
        self._one = RaceVectorEnv(1, config, AutoresetMode.NEXT_STEP)
        self.observation_space = self._one.single_observation_space
        self.action_space = self._one.single_action_space
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin an episode."""
        super().reset(seed=seed, options=options)
        observation, _ = self._one.reset(seed=seed)
        return observation[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Fly one step."""
        observation, reward, terminated, truncated, infos = self._one.step(np.asarray(action)[None])
        info = {"gates_passed": int(infos["gates_passed"][0])}
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def _box(bound: float, shape: tuple[int, ...]) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-bound, bound, shape, np.float32)


def _make_vector(num_envs: int = 1, **arguments: object) -> RaceVectorEnv:
    return RaceVectorEnv(num_envs, **arguments)


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=RaceEnv, vector_entry_point=_make_vector)
