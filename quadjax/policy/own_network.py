"""A policy's network of the user's own class, in place of a perceptron."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import traverse_util

from quadjax.core.errors import InputError
from quadjax.core.files import check_finite
from quadjax.learners.learner import Network
from quadjax.learners.networks import PARTS, ActorCritic, initial_params


@dataclasses.dataclass(frozen=True)
class OwnNetwork:
    """The parameters of a network of the user's own, and its module once a config names it.

    Attributes:
        module: ``module:Class`` of the ``ActorCritic``.
        params: parameters of ``actor`` and, unless it observes more, of ``critic``.
        network: the module; None until it is bound to a config that the user named.
    """

    module: str
    params: Mapping[str, Any]
    network: ActorCritic | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a policy file."""
        flat = traverse_util.flatten_dict(self.params, sep="/")
        return {name: np.asarray(value, np.float32) for name, value in flat.items()}

    def bound(self) -> ActorCritic:
        """The module.

        Raises:
            InputError: no config has named it.
        """
        if self.network is None:
            raise InputError(
                f"the policy's network is the class {self.module}; to import it, name a config "
                f"with network.module={self.module}"
            )
        return self.network

    def bind(
        self, path: Path, sizes: tuple[int, int], clip_mean: bool, section: Network
    ) -> "OwnNetwork":
        """The network with the module of a config.

        Args:
            path: of the policy file, for messages.
            sizes: of an observation and of an action.
            clip_mean: whether the mean action is clipped before noise is added.
            section: of the config.

        Raises:
            InputError: the config names another class, or its parameters have other shapes.
        """
        if section.module != self.module:
            raise InputError(
                f"{path}: its network is {self.module}, the config has network.module="
                f"{section.module or 'null'}"
            )
        network = section.make(sizes[1], clip_mean=clip_mean)
        expected = jax.eval_shape(lambda: initial_params(network, jax.random.key(0), sizes[0]))
        shapes = {x: expected[x] for x in self.params}
        if jax.tree.map(np.shape, self.params) != jax.tree.map(lambda x: x.shape, shapes):
            raise InputError(
                f"{path}: its arrays are not the parameters of {self.module} with network.hidden="
                f"{list(section.hidden)}"
            )
        return dataclasses.replace(self, network=network)


def read_own_network(path: Path, arrays: dict[str, np.ndarray], module: str) -> OwnNetwork:
    """The network of a policy file's arrays.

    Raises:
        InputError: no such arrays, or a number that is not finite.
    """
    flat = {name: array for name, array in arrays.items() if name.split("/")[0] in PARTS}
    if "actor" not in (name.split("/")[0] for name in flat):
        raise InputError(f"{path}: has no parameters of the actor of {module}")
    for name in flat:
        if any(other.startswith(f"{name}/") for other in flat):
            raise InputError(f"{path}: {name} is an array and a group of arrays")
    params = traverse_util.unflatten_dict(flat, sep="/")
    for name, array in flat.items():
        check_finite(path, name, array)
    return OwnNetwork(module, params)
