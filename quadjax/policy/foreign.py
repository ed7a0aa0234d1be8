"""Policies of other projects: Stable-Baselines3, PyTorch state dicts, C arrays.

Nothing in such a file is executed. It has the network's weights; its observation and
commands are those of a race, whose config the caller names.
"""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import check_finite
from quadjax.policy import c_arrays
from quadjax.policy.torch_files import MAX_BYTES, linear_layers, read_state_dict

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.policy.file import Layers, Policy
    from quadjax.race.layout import Layout
    from quadjax.vehicle.protocol import VehicleModel

Arrays = Mapping[str, np.ndarray]
TORCH, ZIP = (".pt", ".pth"), (".zip",)
SUFFIXES = (*ZIP, *TORCH, *c_arrays.SUFFIXES)
SB3_POLICY, SB3_VALUE = "mlp_extractor.policy_net.", "mlp_extractor.value_net."
SB3_MEMBER, SB3_DATA = "policy.pth", "data"  # of a Stable-Baselines3 model


@dataclasses.dataclass(frozen=True)
class Network:
    """The numbers of a policy in a file of another project.

    Attributes:
        layers: kernel (in, out) and bias (out,) of each.
        log_std: (actions,) logarithm of the noise's standard deviation; None where the file has
            none.
        activation: "relu" or "tanh"; None where the file has none.
        value: layers of the critic; None where there are none.
    """

    layers: "Layers"
    log_std: np.ndarray | None
    activation: str | None
    value: "Layers | None" = None


def is_foreign(path: Path | str) -> bool:
    """Whether a path has the suffix of another project's file."""
    return Path(path).suffix.lower() in SUFFIXES


def read_network(path: Path | str) -> Network:
    """The network of a file, by its suffix.

    - ``.zip``: a model of Stable-Baselines3 (PPO or A2C, ``MlpPolicy``);
    - ``.pt``, ``.pth``: a PyTorch state dict, of Stable-Baselines3's policy or of linear layers in
      the order of their application, optionally with ``log_std``;
    - ``.c``, ``.h``, ``.cpp``, ``.hpp``: see ``quadjax.policy.c_arrays.read_c_network``.

    Raises:
        InputError: another suffix, or a file that cannot be read; in one line.
    """
    suffix = Path(path).suffix.lower()
    if c_arrays.is_c(path):
        source = c_arrays.read_c_network(path)
        log_std = None if source.std is None else np.log(source.std)
        return Network(source.layers, log_std, source.activation)
    if suffix in TORCH:
        return _of_tensors(path, read_state_dict(path))
    if suffix not in ZIP:
        raise InputError(f"{path}: suffix is {suffix!r}, allowed: {', '.join(SUFFIXES)}")
    tensors = read_state_dict(path, SB3_MEMBER)
    if not any(name.startswith(SB3_POLICY) for name in tensors):
        raise InputError(f"{path}: no {SB3_POLICY}*, expected a model of PPO or A2C with MlpPolicy")
    own = _of_tensors(path, tensors)
    return dataclasses.replace(own, activation=_sb3_activation(path))


def _of_tensors(path: Path | str, tensors: Arrays) -> Network:
    """The network of a state dict."""
    rest = {name: array for name, array in tensors.items() if name != "log_std"}
    log_std = tensors.get("log_std")
    if log_std is not None and log_std.ndim != 1:
        raise InputError(
            f"{path}: log_std has shape {log_std.shape}, expected a number per action (no gSDE)"
        )
    if not any(name.startswith(("mlp_extractor.", "action_net.")) for name in rest):
        return Network(linear_layers(path, rest), log_std, None)
    known = (SB3_POLICY, SB3_VALUE, "action_net.", "value_net.")
    for name in rest:
        if not name.startswith(known):
            raise InputError(f"{path}: has {name}, expected MlpPolicy with separate networks")
    policy, value = (
        linear_layers(path, {name: rest[name] for name in rest if name.startswith(parts)})
        for parts in ((SB3_POLICY, "action_net."), (SB3_VALUE, "value_net."))
    )
    return Network(policy, log_std, None, value)


def _sb3_activation(path: Path | str) -> str | None:
    """The activation of a Stable-Baselines3 model, whose ``data`` is JSON; tanh by default.

    Objects in it are pickled. Only the text representations next to them are read.
    """
    try:
        with ZipFile(path) as archive:
            if archive.getinfo(SB3_DATA).file_size > MAX_BYTES:
                return None
            data = json.loads(archive.read(SB3_DATA))
        kwargs: Any = data.get("policy_kwargs") or {}
        found, sde = str(kwargs.get("activation_fn", "Tanh")), bool(data.get("use_sde"))
    except (BadZipFile, KeyError, ValueError, AttributeError, RuntimeError, OSError):
        return None
    if sde:
        raise InputError(f"{path}: use_sde is true, expected state-independent noise")
    named = re.search(r"(\w+)\W*$", found)
    return named.group(1).lower() if named else None


def sort_files(
    files: Sequence[str], std: float | None
) -> tuple[list[str], np.ndarray | float | None]:
    """Sort files into networks and standard deviations.

    The standard deviations are ``std`` unless a file contains only ``output_std``.

    Raises:
        InputError: another number of files, or standard deviations twice.
    """
    stds = {name: c_arrays.read_c_std(name) for name in files if c_arrays.is_c(name)}
    of_std = [name for name, values in stds.items() if values is not None]
    networks = [name for name in files if name not in of_std]
    if len(of_std) > 1 or (of_std and len(networks) == 2) or not 1 <= len(networks) <= 3:
        raise InputError(
            f"{len(networks)} networks and {len(of_std)} files with output_std, allowed: a policy "
            "(and output_std), thrust and moment, or policy, thrust and moment (and output_std)"
        )
    if of_std and std is not None:
        raise InputError(f"--std has no effect, {of_std[0]} has output_std")
    return networks, stds[of_std[0]] if of_std else std


def policy_of(
    path: Path | str,
    config: "Config | Path | str",
    activation: str | None = None,
    std: float | np.ndarray | None = None,
    motors: Sequence[int] | None = None,
    actuator_range: tuple[float, float] | None = None,
) -> "Policy":
    """The policy of a file, for the race that it was trained in.

    Args:
        path: of the file; see ``read_network``.
        config: of the race, whose observation and commands are those of the network.
        activation: of the hidden layers, "relu" or "tanh", where the file has none.
        std: standard deviation of the noise, one or (actions,), where the file has none.
        motors: the network's numbers (1 to 4) of the motors front-left, front-right, rear-right,
            rear-left; None: in this order.
        actuator_range: of the actuators that the network observes as -1 and 1, in the vehicle
            model's unit; None: that of the config.

    Raises:
        InputError: a file that cannot be read, or a network that does not fit the race.
    """
    from quadjax.config.loading import load_config
    from quadjax.config.race import race_of
    from quadjax.config.schema import Config
    from quadjax.policy.file import ACTIVATIONS, Policy
    from quadjax.policy.pilot import command_ranges

    config = config if isinstance(config, Config) else load_config(config)
    choices, params = race_of(config)
    own = read_network(path)
    if own.activation and activation and own.activation != activation:
        raise InputError(f"{path}: its activation is {own.activation}, not {activation}")
    activation = own.activation or activation
    if activation not in ACTIVATIONS:
        found = f"is {activation}" if activation else "is not in the file, give it (--activation)"
        raise InputError(f"{path}: the activation {found}, allowed: {', '.join(ACTIVATIONS)}")
    if actuator_range is not None and not actuator_range[0] < actuator_range[1]:
        given = list(actuator_range)
        raise InputError(f"actuator_range is {given}, allowed: the lowest below the highest")
    low, high = command_ranges(choices, params)
    log_std = _log_std(path, own, len(low), std)
    layout = choices.layout.with_spans(choices.model, params)
    _check_sizes(path, own.layers, layout, choices.model, config.name)
    layers, name = own.layers, choices.model.actuators.name
    if actuator_range is not None:
        spanned = dataclasses.replace(layout[name], span=(actuator_range,) * layout[name].size)
        layout = type(layout)(tuple(spanned if f.name == name else f for f in layout.fields))
    if motors is not None:
        if any(field.name == "last_action" for field in layout.fields):
            raise InputError(
                f"{path}: motors {list(motors)}, allowed: none with observation.last_action"
            )
        layers, log_std = _reordered(path, layers, log_std, layout.slice(name), motors)
    return Policy(
        layers=layers,
        log_std=log_std,
        vehicle=choices.model.name,
        activation=activation,
        command_low=low,
        command_high=high,
        layout=layout,
        source={"imported": Path(path).name},
        value=own.value if motors is None else None,
        config=config.model_dump(mode="json", by_alias=True),
    )


def _reordered(
    path: Path | str, layers: "Layers", log_std: np.ndarray, seen: slice, motors: Sequence[int]
) -> tuple["Layers", np.ndarray]:
    """A network with its motors, observed and commanded, in the order of this project."""
    order = np.array(motors) - 1
    size = seen.stop - seen.start
    if sorted(order) != list(range(len(log_std))) or size != len(order):
        raise InputError(
            f"{path}: motors {list(motors)}, expected each of 1 to {len(log_std)} once, and a "
            "vehicle model that observes as many propeller speeds"
        )
    (first, bias), *rest = layers
    first = first.copy()
    first[seen] = first[seen][order]
    *rest, (last, offset) = [(first, bias), *rest]
    return (*rest, (last[:, order], offset[order])), log_std[order]


def _log_std(
    path: Path | str, own: Network, actions: int, std: float | np.ndarray | None
) -> np.ndarray:
    if own.log_std is not None and std is not None:
        raise InputError(f"{path}: has a standard deviation, so std {std} has no effect")
    log_std = own.log_std
    if std is not None:
        log_std = np.log(std if np.ndim(std) else np.full(actions, std))
    if log_std is None:
        hint = "give the noise's std (--std) or the file that has it"
        raise InputError(f"{path}: no log_std or output_std, {hint}")
    if log_std.shape != (actions,):
        raise InputError(f"{path}: {log_std.size} standard deviations, expected {actions}")
    check_finite(path, "log_std", log_std)
    return log_std.astype(np.float32)


def _check_sizes(
    path: Path | str, layers: "Layers", layout: "Layout", model: "VehicleModel", race: str
) -> None:
    """Check that a network observes and commands what policies of the race do."""
    inputs, outputs = layers[0][0].shape[0], layers[-1][0].shape[1]
    if inputs != layout.size:
        fields = ", ".join(f"{field.name} {field.size}" for field in layout.fields)
        raise InputError(
            f"{path}: the network takes {inputs} numbers, policies of {race} observe {layout.size}:"
            f" {fields}"
        )
    if outputs != model.action_size:
        raise InputError(
            f"{path}: the network gives {outputs} numbers, the vehicle model {model.name} takes "
            f"{model.action_size}"
        )
