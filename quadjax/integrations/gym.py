"""The race as a Gymnasium environment: ``gymnasium.make_vec("quadjax/Race-v0", num_envs=256)``.

All environments of a vector are one compiled program.
"""

import functools
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config
from quadjax.core.environment import Environment, Vectorized, where_done
from quadjax.core.errors import InputError
from quadjax.core.forks import refuse_forked
from quadjax.core.precision import single_precision
from quadjax.core.sections import MAX_RUNS, check_integer
from quadjax.race.types import RaceParams, RaceState

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError:
    raise InputError(
        "this needs Gymnasium, which is not installed: pip install 'quadjax[gym]'"
    ) from None

Info = dict[str, Any]
Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]
ID = "quadjax/Race-v0"
ONE_PROCESS = f"gymnasium.make_vec({ID!r}, num_envs=N), whose drones are one program"
DEFAULT_CONFIG = "e2e"
Named = Config | Path | str  # a config, a preset's name or a YAML file


class Batch(struct.PyTreeNode):
    """All environments between two calls."""

    state: RaceState  # batched along the last axis
    over: jax.Array  # (n,) bool: the episode has ended and is not reset yet
    key: jax.Array  # () PRNG key


def step_all(
    environments: Environment,
    mode: AutoresetMode,
    params: RaceParams,
    batch: Batch,
    action: jax.Array,
) -> tuple[Batch, dict[str, jax.Array]]:
    """One step of every environment, with resets as the mode defines them.

    ``SAME_STEP`` resets within the step that ends an episode. ``NEXT_STEP`` resets in the step
    after it, whose action, reward and flags have no effect. ``DISABLED`` leaves it to the caller.

    Returns:
        The environments, and what a step returns, (n, ..): ``observation`` is of the next episode
        where it has begun, ``final`` of the step itself, as the gates that it passed.
    """
    next_states, reward, terminated, truncated = environments.step(params, batch.state, action)
    key, reset_key = jax.random.split(batch.key)
    late = batch.over & (mode == AutoresetMode.NEXT_STEP)
    reward = jnp.where(late, 0.0, reward)
    terminated, truncated = terminated & ~late, truncated & ~late
    done = terminated | truncated
    none = jnp.zeros_like(done)
    resets = {AutoresetMode.SAME_STEP: done, AutoresetMode.NEXT_STEP: late}.get(mode, none)

    def reset_done() -> tuple[RaceState, jax.Array]:
        keys = jax.random.split(reset_key, action.shape[0])
        state = where_done(resets, environments.reset(params, keys), next_states)
        return state, environments.observe(params, state)

    final = environments.observe(params, next_states)
    state, observation = jax.lax.cond(resets.any(), reset_done, lambda: (next_states, final))
    return Batch(state, done, key), {
        "observation": observation,
        "final": final,
        "reward": reward,
        "terminated": terminated,
        "truncated": truncated,
        "gates_passed": jnp.where(late, 0, next_states.gates_passed),
    }


@functools.lru_cache(maxsize=4)
def _programs(environment: Environment) -> tuple[Callable, Callable, Callable]:
    """Reset, observe and step of a vector; vectors of the same environment compile them once."""
    environments = Vectorized(environment)
    step = jax.jit(functools.partial(step_all, environments), static_argnums=0)
    return jax.jit(environments.reset), jax.jit(environments.observe), step


class RaceVectorEnv(VectorEnv):
    """A race as a vector environment of ``num_envs`` drones.

    Observations are (num_envs, observation_size) float32; actions are (num_envs, action_size)
    float32 in [-1, 1] and are clipped. ``terminated`` is a crash or a violated limit, ``truncated``
    the end of the clock. Limits, gate inflation and rewards are those of training. Schedules are
    not applied: every number has the config's value.

    Infos: ``gates_passed`` (num_envs,) of the episode; with ``SAME_STEP`` also ``final_obs``,
    the observations in which episodes ended, and ``final_info``.
    """

    @single_precision
    def __init__(
        self,
        environment: Environment,
        params: RaceParams,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        seed: int | None = None,
        render_mode: None = None,
    ) -> None:
        """Prepare the race, which ``quadjax.make_race`` returns; nothing is compiled yet.

        ``seed`` is of the first ``reset`` without one (None: a random seed); ``autoreset_mode``
        says when the next episode begins: same step, next step, or disabled.

        Raises:
            InputError: a render mode, or a number of environments that is not at least 1.
        """
        check_integer("num_envs", num_envs, 1, MAX_RUNS)
        if render_mode is not None:
            allowed = "None (quadjax view draws flights)"
            raise InputError(f"render_mode is {render_mode!r}, allowed: {allowed}")
        self.num_envs, self._mode = num_envs, AutoresetMode(autoreset_mode)
        self._params = params
        self.metadata = {"autoreset_mode": self._mode, "render_modes": []}
        self._reset, self._observe, self._step = _programs(environment)
        size = environment.observation_size
        self.single_observation_space = _box(np.inf, (size,))
        self.single_action_space = _box(1.0, (environment.action_size,))
        self.observation_space = _box(np.inf, (num_envs, size))
        self.action_space = _box(1.0, (num_envs, environment.action_size))
        self._key = jax.random.key(secrets.randbits(31) if seed is None else seed)
        self._batch: Batch | None = None
        self._last = np.zeros((num_envs, size), np.float32)  # observations

    @single_precision
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Reset all environments, or those of ``options["reset_mask"]``, (num_envs,) bool.

        Raises:
            InputError: in a process that was forked after JAX had started.
        """
        refuse_forked(ONE_PROCESS)
        super().reset(seed=seed, options=options)
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, reset_key, key = jax.random.split(self._key, 3)
        state = self._reset(self._params, jax.random.split(reset_key, self.num_envs))
        rows, over = np.asarray(self._observe(self._params, state)), np.zeros(self.num_envs, bool)
        mask = (options or {}).get("reset_mask")
        if mask is not None and self._batch is not None:
            mask = np.asarray(mask, bool)
            state = where_done(jnp.asarray(mask), state, self._batch.state)
            rows = np.where(mask[:, None], rows, self._last)
            over = np.asarray(self._batch.over) & ~mask
        self._batch, self._last = Batch(state, jnp.asarray(over), key), rows
        return self._last.copy(), {}

    @single_precision
    def step(self, actions: np.ndarray) -> Step:
        """Simulate one step of every drone.

        Raises:
            RuntimeError: before the first ``reset``, or, with ``DISABLED``, where an episode has
                ended and was not reset.
            InputError: in a process that was forked after JAX had started.
        """
        refuse_forked(ONE_PROCESS)
        if self._batch is None:
            raise RuntimeError("reset has to be called before step")
        if self._mode == AutoresetMode.DISABLED and bool(self._batch.over.any()):
            raise RuntimeError("an episode is over: call reset (a vector: options reset_mask)")
        shaped = jnp.asarray(actions, jnp.float32).reshape(self.action_space.shape)
        self._batch, outcome = self._step(self._mode, self._params, self._batch, shaped)
        result = {name: np.array(values) for name, values in jax.device_get(outcome).items()}
        terminated, truncated, passed = (
            result[name] for name in ("terminated", "truncated", "gates_passed")
        )
        done, every = terminated | truncated, np.ones(self.num_envs, bool)
        infos: Info = {"gates_passed": passed, "_gates_passed": every}
        if self._mode == AutoresetMode.SAME_STEP and done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(done):
                final[index] = result["final"][index]
            last = {"gates_passed": passed, "_gates_passed": done}
            infos |= {"final_obs": final, "_final_obs": done}
            infos |= {"final_info": last, "_final_info": done}
        self._last = result["observation"]
        reward = result["reward"].astype(np.float64)
        return self._last.copy(), reward, terminated, truncated, infos


class RaceEnv(gymnasium.Env):
    """One drone's race, as ``gymnasium.Env``; after an episode's end the caller resets it."""

    metadata = {"render_modes": []}

    def __init__(
        self, environment: Environment, params: RaceParams, render_mode: None = None
    ) -> None:
        """Prepare the race, which ``quadjax.make_race`` returns.

        Raises:
            InputError: a render mode.
        """
        mode = AutoresetMode.DISABLED
        self._one = RaceVectorEnv(environment, params, 1, mode, render_mode=render_mode)
        self.observation_space = self._one.single_observation_space
        self.action_space = self._one.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Reset the environment."""
        super().reset(seed=seed, options=options)
        observation, _ = self._one.reset(seed=seed)
        return observation[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Simulate one step.

        Raises:
            RuntimeError: before ``reset``, or after the end of an episode that was not reset.
        """
        observation, reward, terminated, truncated, infos = self._one.step(np.asarray(action)[None])
        info = {"gates_passed": int(infos["gates_passed"][0])}
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def _box(bound: float, shape: tuple[int, ...]) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-bound, bound, shape, np.float32)


def _make(config: Named = DEFAULT_CONFIG, **options: Any) -> RaceEnv:
    return RaceEnv(*make_race(config), **options)


def _make_vector(config: Named = DEFAULT_CONFIG, **options: Any) -> RaceVectorEnv:
    return RaceVectorEnv(*make_race(config), **options)


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=_make, vector_entry_point=_make_vector)
