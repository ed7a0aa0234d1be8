"""The race for Stable-Baselines3: its vector environment interface around ``RaceVectorEnv``.

Stable-Baselines3 distinguishes a truncation from a crash by ``infos[i]["TimeLimit.truncated"]`` and
bootstraps from ``infos[i]["terminal_observation"]``, the observation before the reset.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.integrations.gym import AutoresetMode, RaceVectorEnv
from quadjax.race.types import RaceParams

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    VecEnv = object  # so that the module can be imported and documented without it

Indices = None | int | Iterable[int]


class RaceVecEnv(VecEnv):
    """``num_envs`` drones of a race."""

    def __init__(
        self, environment: Environment, params: RaceParams, num_envs: int, seed: int | None = None
    ) -> None:
        """Prepare the race, which ``quadjax.make_race`` returns; a seed of None is a random one.

        Raises:
            InputError: Stable-Baselines3 is not installed.
        """
        if VecEnv is object:
            raise InputError(
                "this needs Stable-Baselines3, which is not installed: pip install 'quadjax[sb3]'"
            )
        mode = AutoresetMode.SAME_STEP
        self._race = RaceVectorEnv(environment, params, num_envs, mode, seed)
        self._action: np.ndarray | None = None
        self.render_mode = None
        super().__init__(
            num_envs, self._race.single_observation_space, self._race.single_action_space
        )

    def reset(self) -> np.ndarray:
        """Reset all environments."""
        seed = self._seeds[0]
        self._reset_seeds()
        observation, _ = self._race.reset(seed=seed)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for ``step_wait``."""
        self._action = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        """Simulate one step of every drone."""
        assert self._action is not None, "step_async comes before step_wait"
        observation, reward, terminated, truncated, race = self._race.step(self._action)
        done = terminated | truncated
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": race["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """No resources to release."""

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[object]:
        """An attribute, the same for every drone."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        """Set an attribute for all drones."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: object, indices: Indices = None, **named: object
    ) -> list[object]:
        """Drones have no methods of their own."""
        raise NotImplementedError("the drones of a race are one program")

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> Sequence[bool]:
        """No drone is wrapped by itself."""
        return [False] * len(list(self._get_indices(indices)))
