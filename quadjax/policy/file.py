"""A trained policy, and the file that holds it: plain arrays that NumPy alone can read and write.

Arrays, finite and at most 1e6 in magnitude: ``kernel_0..`` (inputs, outputs) and ``bias_0..`` of
each layer, ``log_std`` (actions,), the logarithm of the standard deviation of the action noise, and
optionally the critic, ``value_kernel_0..`` and ``value_bias_0..``, which training from the file
starts with. ``meta`` is a JSON string with

- ``format``: ``quadjax-policy/2``;
- ``vehicle``: name of the vehicle model, ``motor``, ``rate`` or your own;
- ``activation`` of the hidden layers: ``relu`` or ``tanh``;
- ``noise_on``: what the noise is added to, ``mean`` or ``clipped_mean``;
- ``command_low`` and ``command_high``: commands of the actions -1 and 1;
- ``layout``: the fields of the observation, in order (see ``quadjax.race.layout``);
- ``source``: where the policy comes from, for the reader (optional);
- ``config``: the full training config (optional). Without it, commands need the config of the race
  that the policy flies: CONFIG or ``--race``;
- ``residual``: numbers of the residual of the training, whose arrays are in the file (optional).

A policy with a network of the user's own (``network.module``) has, in place of ``kernel_0`` .. and
of the critic's arrays, those of the Flax parameters, such as ``actor/Dense_0/kernel`` and
``critic/Dense_0/kernel`` (of the scaled reward), and ``module``, the ``module:Class``, in ``meta``.
The class is imported only if a config that the user names contains it.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import check_finite, read_layers, read_npz, write_npz
from quadjax.core.mlp import to_params
from quadjax.core.precision import single_precision
from quadjax.core.resources import policy_file
from quadjax.core.sections import LARGEST, Field, Section, validate
from quadjax.learners.networks import ActorCritic
from quadjax.policy import inference
from quadjax.policy.inference import PolicyParams
from quadjax.policy.network_files import SUFFIXES, Layers
from quadjax.policy.own_network import OwnNetwork, read_own_network
from quadjax.race.layout import Layout
from quadjax.vehicle.residual import Residual, from_arrays, to_arrays

if TYPE_CHECKING:
    from quadjax.config.schema import Config

FORMAT = "quadjax-policy/2"
VALUE = "value_"  # prefix of the critic's arrays
Command = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Commands = Annotated[tuple[Command, ...], Field(max_length=100)]


class Meta(Section):
    """The metadata of a policy file but for its layout, source, config and residual."""

    vehicle: str
    activation: Literal["relu", "tanh"]
    command_low: Commands
    command_high: Commands
    output: Literal["clip"] = "clip"
    noise_on: Literal["mean", "clipped_mean"] = "mean"
    module: Annotated[str, Field(pattern=r"^[\w.]+:[\w.]+$", max_length=200)] | None = None


@dataclasses.dataclass(frozen=True)
class Policy:
    """A stochastic policy: dense layers, Gaussian noise, and what it observes and commands.

    The mean action is the network's output; an action in [-1, 1] is scaled to [``command_low``,
    ``command_high``].

    Attributes:
        layers: kernel (in, out) and bias (out,) of each layer.
        log_std: (actions,) natural logarithm of the noise's standard deviation.
        vehicle: name of the vehicle model.
        activation: activation of the hidden layers, "relu" or "tanh".
        command_low: (actions,) lowest commands, in the units of the model's commands.
        command_high: (actions,) highest commands.
        layout: the fields of the observation, with the scale of each.
        source: where the policy comes from.
        noise_on: "mean" or "clipped_mean": what the noise of a sample is added to.
        value: layers of the critic, (observation,) -> (1,), in the reward's own unit.
        config: the full training config, as plain dicts and lists; None where unknown.
        residual: the residual networks of the training, unless they come with the package.
        own: a network of the user's own class, in place of ``layers`` and ``value``.
    """

    layers: Layers
    log_std: np.ndarray
    vehicle: str
    activation: str
    command_low: np.ndarray
    command_high: np.ndarray
    layout: Layout
    source: dict[str, Any] = dataclasses.field(default_factory=dict)
    noise_on: str = "mean"
    value: Layers | None = None
    config: dict[str, Any] | None = None
    residual: Residual | None = None
    own: OwnNetwork | None = None

    def __repr__(self) -> str:
        """One line, without the numbers."""
        return f"Policy({self.describe()}, vehicle model {self.vehicle})"

    @classmethod
    def load(
        cls,
        path: Path | str,
        config: "Config | Path | str | None" = None,
        *,
        activation: str | None = None,
        std: float | None = None,
    ) -> "Policy":
        """Read and check a policy file, or import one of another project.

        Args:
            path: a policy file (``.npz``), the folder of a run, or the name of a shipped policy;
                or a model of Stable-Baselines3 (``.zip``), a PyTorch state dict (``.pt``, ``.pth``)
                or C arrays (``.c``, ``.h``), which need a config. Nothing in them is executed. The
                first two need Stable-Baselines3 and PyTorch.
            config: of the race that a file of another project was trained in: a config, a preset's
                name or a YAML file. A policy file needs it only for a network of the user's own
                class, which the config has to name.
            activation: of an imported network whose file has none, "relu" or "tanh".
            std: standard deviation of the noise of an imported network whose file has none.

        Raises:
            InputError: a missing, damaged or inconsistent file, in one line.
        """
        path = policy_file(path)
        if path.suffix.lower() in SUFFIXES:
            from quadjax.policy.foreign import import_policy

            if config is None:
                raise InputError(
                    f"{path}: not a policy file, so it also needs the config of the race that "
                    "the network was trained in"
                )
            return import_policy(path, config, activation, std)
        policy = _read(path)
        if policy.own is None or config is None:
            return policy
        race = load_config(config) if isinstance(config, Path | str) else config
        sizes, clip_mean = (policy.layout.size, len(policy.log_std)), policy.clip_mean
        own = policy.own.bind(path, sizes, clip_mean, race.network)
        if race.network.activation != policy.activation:
            raise InputError(
                f"{path}: its network has the activation {policy.activation}, the config has "
                f"network.activation={race.network.activation}"
            )
        return dataclasses.replace(policy, own=own)

    @property
    def has_critic(self) -> bool:
        """Whether the file has the critic, with which a training can start."""
        return self.value is not None if self.own is None else "critic" in self.own.params

    @property
    def clip_mean(self) -> bool:
        """Whether noise is added to the clipped mean."""
        return self.noise_on == "clipped_mean"

    def on_device(self) -> PolicyParams:
        """The parameters of the policy on the device, as ``quadjax.policy.inference`` takes them.

        Raises:
            InputError: a network of the user's own whose class no config has named.
        """
        if self.own is not None:
            network, actor = self.own.bound(), self.own.params["actor"]
        else:
            actor, hidden = to_params(self.layers), tuple(len(x) for _, x in self.layers[:-1])
            network = ActorCritic(len(self.log_std), hidden, self.activation, self.clip_mean)
        params = {"actor": actor, "log_std": self.log_std}
        return PolicyParams(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params), network)

    def describe(self) -> str:
        """Widths of the layers and activation, such as ``24-64-64-4, relu``, or the own class."""
        if self.own is not None:
            return self.own.module
        sizes = [self.layers[0][0].shape[0], *(len(bias) for _, bias in self.layers)]
        return f"{'-'.join(map(str, sizes))}, {self.activation}"

    def save(self, path: Path | str) -> None:
        """Write a policy file atomically."""
        arrays: dict[str, np.ndarray] = {"log_std": np.asarray(self.log_std, np.float32)}
        for prefix, layers in (("", self.layers), (VALUE, self.value or ())):
            for index, (kernel, bias) in enumerate(layers):
                arrays[f"{prefix}kernel_{index}"] = np.asarray(kernel, np.float32)
                arrays[f"{prefix}bias_{index}"] = np.asarray(bias, np.float32)
        meta = self.meta
        if self.own is not None:
            arrays |= self.own.arrays()
            meta["module"] = self.own.module
        if self.residual is not None:
            more, meta["residual"] = to_arrays(self.residual)
            arrays |= more
        write_npz(path, arrays, meta)

    @property
    def meta(self) -> dict[str, Any]:
        """The metadata of the file."""
        return {
            "format": FORMAT,
            "vehicle": self.vehicle,
            "activation": self.activation,
            "output": "clip",
            "noise_on": self.noise_on,
            "command_low": [float(x) for x in self.command_low],
            "command_high": [float(x) for x in self.command_high],
            "layout": self.layout.to_meta(),
            "source": self.source,
            "config": self.config,
        }

    def __call__(self, observation: jax.Array) -> jax.Array:
        """The mean action, as ``mean``: a ``TrainResult.policy`` is called in the same way."""
        return self.mean(observation)

    @single_precision
    def mean(self, observation: jax.Array) -> jax.Array:
        """The mean action (.., actions) of observations (.., layout.size), clipped to [-1, 1]."""
        return jnp.clip(inference.mean_action(self.on_device(), observation), -1, 1)

    @single_precision
    def sample(self, observation: jax.Array, key: jax.Array) -> jax.Array:
        """Actions (.., actions) in [-1, 1], drawn with a PRNG key."""
        params = self.on_device()
        shape = (*jnp.shape(observation)[:-1], len(self.log_std))
        noise = jax.random.normal(key, shape)
        return jnp.clip(inference.act_sampled(params, observation, noise), -1, 1)


def _read(path: Path) -> Policy:
    """The policy of a file of this project."""
    arrays, meta = read_npz(path, FORMAT)
    values = {key: meta[key] for key in Meta.model_fields if key in meta}
    stated = validate(Meta, values, f"{path}: meta")
    own = read_own_network(path, arrays, stated.module) if stated.module else None
    layers = tuple(read_layers(path, arrays)) if own is None else ()
    actions = layers[-1][0].shape[1] if layers else max(1, np.size(arrays.get("log_std", ())))
    low, high = np.array(stated.command_low), np.array(stated.command_high)
    if not len(low) == len(high) == actions or not np.all(low < high):
        raise InputError(
            f"{path}: meta: command_low is {low.tolist()} and command_high {high.tolist()}, "
            f"expected {actions} numbers each, as many as the last layer has outputs, the "
            "first below the second"
        )
    layout = Layout.from_meta(meta.get("layout"), f"{path}: meta 'layout'")
    if layers and layers[0][0].shape[0] != layout.size:
        raise InputError(
            f"{path}: kernel_0 takes {layers[0][0].shape[0]} inputs, but the policy observes "
            f"{layout.size} numbers"
        )
    source, config = meta.get("source") or {}, meta.get("config")
    config, residual = config if isinstance(config, dict) else None, None
    if "residual" in meta:
        residual = from_arrays(path, arrays, meta["residual"])
        if config and isinstance(config.get("vehicle"), dict):  # read from this file
            config["vehicle"]["residual"] = str(path)
    return Policy(
        layers=layers,
        log_std=_log_std(path, arrays, actions),
        vehicle=stated.vehicle,
        activation=stated.activation,
        command_low=low,
        command_high=high,
        layout=layout,
        source=source if isinstance(source, dict) else {"source": source},
        noise_on=stated.noise_on,
        value=_value(path, arrays, layout.size),
        config=config,
        residual=residual,
        own=own,
    )


def _log_std(path: Path | str, arrays: dict[str, np.ndarray], actions: int) -> np.ndarray:
    log_std = arrays.get("log_std")
    if log_std is None or log_std.shape != (actions,):
        raise InputError(f"{path}: log_std is missing or not of shape ({actions},)")
    check_finite(path, "log_std", log_std)
    return log_std


def _value(path: Path | str, arrays: dict[str, np.ndarray], inputs: int) -> Layers | None:
    """The critic's layers, from ``inputs`` numbers to one, where the file has them."""
    if not any(name.startswith((f"{VALUE}kernel_", f"{VALUE}bias_")) for name in arrays):
        return None
    layers = read_layers(path, arrays, VALUE)
    sizes = (layers[0][0].shape[0], layers[-1][0].shape[1])
    if sizes != (inputs, 1):
        raise InputError(
            f"{path}: the value's layers take {sizes[0]} numbers and give {sizes[1]}, expected "
            f"{inputs} and 1"
        )
    return tuple(layers)
