"""The policy file: a trained policy as plain arrays, which NumPy alone can read and write.

``kernel_0..`` (in, out), ``bias_0..``, ``log_std`` (4,) and ``meta``, a JSON string with
``format: "quadjax-policy/1"``, ``vehicle: "motor" | "rate"``, ``activation``, ``output``
(``"clip"`` where it is missing), ``command_low``, ``command_high``, ``observation`` and where the
policy came from. It may have ``value_kernel_0..`` and ``value_bias_0..``, the critic that it was
trained with: what trains the policy on begins with it, and nothing else looks at it.
"""

import dataclasses
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import check_finite, read_layers, read_npz, write_npz

FORMAT = "quadjax-policy/1"
OBSERVATION_SIZES = {"motor": 24, "rate": 17}
ACTION_SIZE = 4
VALUE = "value_"  # before the names of the critic's arrays
ACTIVATIONS = ("relu", "tanh")
OUTPUTS = ("clip", "tanh")
NOISE = ("mean", "clipped_mean")


Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # (kernel (in, out), bias (out,)) of each


@dataclasses.dataclass(frozen=True)
class Policy:
    """A policy: dense layers, the noise it was trained with, and what it commands.

    The mean action is the network's output, squashed by ``output`` to [-1, 1] and scaled to
    [``command_low``, ``command_high``].
    """

    layers: Layers
    log_std: np.ndarray  # (4,) natural logarithm of the actions' standard deviation
    vehicle: str  # "motor" | "rate"
    activation: str  # of the hidden layers
    output: str  # "clip" | "tanh"
    command_low: np.ndarray  # (4,) rpm, or rad/s and m/s^2
    command_high: np.ndarray  # (4,)
    observation: dict  # the scaling of the observation it was trained with
    source: dict  # where it came from
    noise_on: str = "mean"  # "mean" | "clipped_mean": what the noise of a sample is added to
    value: Layers | None = None  # the critic: (observation,) -> (1,), in the reward's own unit


def write_policy(path: Path | str, policy: Policy) -> None:
    """Write a policy file, whole."""
    arrays: dict[str, np.ndarray] = {"log_std": np.asarray(policy.log_std, np.float32)}
    for prefix, layers in (("", policy.layers), (VALUE, policy.value or ())):
        for index, (kernel, bias) in enumerate(layers):
            arrays[f"{prefix}kernel_{index}"] = np.asarray(kernel, np.float32)
            arrays[f"{prefix}bias_{index}"] = np.asarray(bias, np.float32)
    meta = {
        "format": FORMAT,
        "vehicle": policy.vehicle,
        "activation": policy.activation,
        "output": policy.output,
        "noise_on": policy.noise_on,
        "command_low": [float(x) for x in policy.command_low],
        "command_high": [float(x) for x in policy.command_high],
        "observation": policy.observation,
        "source": policy.source,
    }
    write_npz(path, arrays, meta)


def read_policy(path: Path | str) -> Policy:
    """Read and check a policy file.

    Raises:
        InputError: a missing, damaged or inconsistent file, in one line.
    """
    arrays, meta = read_npz(path, FORMAT)
    vehicle = _choice(path, meta, "vehicle", tuple(OBSERVATION_SIZES))
    layers = read_layers(path, arrays)
    if layers[0][0].shape[0] != OBSERVATION_SIZES[vehicle]:
        raise InputError(
            f"{path}: kernel_0 takes {layers[0][0].shape[0]} inputs, but a {vehicle} policy "
            f"observes {OBSERVATION_SIZES[vehicle]} numbers"
        )
    if layers[-1][0].shape[1] != ACTION_SIZE:
        raise InputError(
            f"{path}: kernel_{len(layers) - 1} has {layers[-1][0].shape[1]} outputs, "
            f"expected {ACTION_SIZE}"
        )
    log_std = arrays.get("log_std")
    if log_std is None or log_std.shape != (ACTION_SIZE,):
        raise InputError(f"{path}: log_std is missing or not of shape ({ACTION_SIZE},)")
    check_finite(path, "log_std", log_std)
    low, high = _command(path, meta, "command_low"), _command(path, meta, "command_high")
    if not np.all(low < high):
        raise InputError(f"{path}: meta 'command_low' {low.tolist()} is not below 'command_high'")
    return Policy(
        layers=tuple(layers),
        log_std=log_std,
        vehicle=vehicle,
        activation=_activation(path, meta),
        output=_choice(path, {"output": "clip"} | meta, "output", OUTPUTS),
        command_low=low,
        command_high=high,
        observation=_observation(path, meta),
        source=_source(meta),
        noise_on=_choice(path, {"noise_on": "mean"} | meta, "noise_on", NOISE),
        value=_value(path, arrays, layers[0][0].shape[0]),
    )


def _value(path: Path | str, arrays: dict[str, np.ndarray], inputs: int) -> Layers | None:
    """The critic's layers, from ``inputs`` numbers to one, where the file has them."""
    if not any(name.startswith((f"{VALUE}kernel_", f"{VALUE}bias_")) for name in arrays):
        return None
    layers = read_layers(path, arrays, VALUE)
    found = (layers[0][0].shape[0], layers[-1][0].shape[1])
    if found != (inputs, 1):
        raise InputError(
            f"{path}: the value's layers take {found[0]} numbers and give {found[1]}, expected "
            f"{inputs} and 1"
        )
    return tuple(layers)


def _choice(path: Path | str, meta: dict, key: str, allowed: tuple[str, ...]) -> str:
    if meta.get(key) not in allowed:
        raise InputError(f"{path}: meta {key!r} is {meta.get(key)!r}, allowed: {list(allowed)}")
    return meta[key]


def _activation(path: Path | str, meta: dict) -> str:
    try:
        return _choice(path, meta, "activation", ACTIVATIONS)
    except InputError as error:
        raise InputError(f"{error}; it is that of layer 0, row 0 and every hidden row") from None


def _observation(path: Path | str, meta: dict) -> dict:
    value = meta.get("observation") or {}
    if not isinstance(value, dict):
        raise InputError(f"{path}: meta 'observation' is {value!r}, expected a mapping")
    return value


def _source(meta: dict) -> dict:
    """Where the policy came from; whoever wrote the file may have put it in their own words."""
    value = meta.get("source") or {}
    return value if isinstance(value, dict) else {"source": value}


def _command(path: Path | str, meta: dict, key: str) -> np.ndarray:
    try:
        value = np.asarray(meta.get(key), np.float64)
    except (TypeError, ValueError):
        value = np.zeros(0)
    if value.shape != (ACTION_SIZE,) or not np.all(np.isfinite(value)):
        raise InputError(
            f"{path}: meta {key!r} is {meta.get(key)!r}, expected {ACTION_SIZE} finite numbers"
        )
    return value
