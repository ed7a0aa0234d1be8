"""Networks in files of other projects: Stable-Baselines3, PyTorch state dicts, C arrays.

Nothing in such a file is executed. PyTorch loads tensors only (``weights_only=True``), and so does
Stable-Baselines3, whose other objects are left unread. C is read as text.
"""

import contextlib
import dataclasses
import importlib
import json
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file, read_layers
from quadjax.policy.c_arrays import C_NAMES, STD, Arrays, pairs, read_arrays

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # (kernel (in, out), bias (out,)) of each
C, TORCH, SB3 = (".c", ".h", ".cpp", ".hpp"), (".pt", ".pth"), (".zip",)
SUFFIXES = (*SB3, *TORCH, *C)
LIBRARIES = {  # name, and the first version that executes nothing in a file
    "torch": ("PyTorch", (2, 6)),
    "stable_baselines3": ("Stable-Baselines3", (2, 8)),
}
SB3_POLICY, SB3_VALUE = "mlp_extractor.policy_net.", "mlp_extractor.value_net."
TORCH_NAMES = re.compile(r"(.*)weight"), r"\1bias"
FORWARD = re.compile(r"forward\s*\([^)]*\)\s*\{([^{}]*)\}")


@dataclasses.dataclass(frozen=True)
class Network:
    """The numbers of a network in a file of another project.

    Attributes:
        layers: kernel (in, out) and bias (out,) of each.
        log_std: (actions,) logarithm of the noise's standard deviation; None where the file has
            none.
        activation: such as "relu" or "tanh"; None where the file has none.
        value: layers of the critic; None where there are none.
    """

    layers: Layers
    log_std: np.ndarray | None = None
    activation: str | None = None
    value: Layers | None = None


def read_network(path: Path | str) -> Network:
    """The network of a file, by its suffix.

    - ``.zip``: a model of Stable-Baselines3 (PPO or A2C, ``MlpPolicy``), by its own loader;
    - ``.pt``, ``.pth``: a state dict, by PyTorch, of Stable-Baselines3's policy or of linear layers
      in the order of their application, optionally with ``log_std``;
    - ``.c``, ``.h``, ``.cpp``, ``.hpp``: arrays ``weights_NAME`` and ``biases_NAME`` in the order
      of the layers, with any prefix, and optionally ``output_std``. Flat weights have a row per
      output; those in two dimensions may also have one per input. The activation is the one that
      the function ``..forward`` calls, or the only one in the file.

    Raises:
        InputError: another suffix, a library that is not installed, or a file that cannot be read;
            in one line.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: suffix is {suffix!r}, allowed: {', '.join(SUFFIXES)}")
    check_file(path)
    if suffix in C:
        network = read_c(path)
        if not network.layers:
            raise InputError(f"{path}: has no weights_.., expected weights_fc1, biases_fc1, ..")
        return network
    if suffix in TORCH:
        return _of_tensors(path, _read_state_dict(path))
    tensors = _read_sb3(path)
    if not any(name.startswith(SB3_POLICY) for name in tensors):
        raise InputError(f"{path}: no {SB3_POLICY}*, expected a model of PPO or A2C with MlpPolicy")
    return dataclasses.replace(_of_tensors(path, tensors), activation=_sb3_activation(path))


def _of_tensors(path: Path | str, tensors: Arrays) -> Network:
    rest = {name: array for name, array in tensors.items() if name != "log_std"}
    log_std = tensors.get("log_std")
    if log_std is not None and log_std.ndim != 1:
        raise InputError(
            f"{path}: log_std has shape {log_std.shape}, expected a number per action (no gSDE)"
        )
    if not any(name.startswith(("mlp_extractor.", "action_net.")) for name in rest):
        return Network(_layers(path, rest, TORCH_NAMES), log_std)
    parts = (SB3_POLICY, "action_net."), (SB3_VALUE, "value_net.")
    for name in rest:
        if not name.startswith((*parts[0], *parts[1])):
            raise InputError(f"{path}: has {name}, expected MlpPolicy with separate networks")
    policy, value = (
        _layers(path, {x: rest[x] for x in rest if x.startswith(prefixes)}, TORCH_NAMES)
        for prefixes in parts
    )
    return Network(policy, log_std, value=value)


def _layers(path: Path | str, arrays: Arrays, names: tuple[re.Pattern[str], str]) -> Layers:
    """The layers of arrays by name, in their order, in single precision.

    Weights are by rows, a row for each output. ``names`` are those of weights and their biases.
    """
    used = pairs(arrays, names)
    if others := set(arrays) - {*used, *used.values()}:
        raise InputError(
            f"{path}: {min(others)} does not belong to a linear layer, expected only linear layers"
        )
    numbered: dict[str, np.ndarray] = {}
    for index, (name, bias) in enumerate(used.items()):
        rows, shape = arrays[bias].size if bias in arrays else 0, arrays[name].shape
        if not rows or arrays[name].size % rows or shape[:-1] not in ((), (rows,)):  # flat in C
            raise InputError(f"{path}: {name} has no {bias} with a number for each of its rows")
        numbered[f"kernel_{index}"] = arrays[name].reshape(rows, -1).T
        numbered[f"bias_{index}"] = arrays[bias]
    layers = read_layers(path, numbered)
    return tuple((kernel.astype(np.float32), bias.astype(np.float32)) for kernel, bias in layers)


def _sb3_activation(path: Path | str) -> str | None:
    """The activation of a Stable-Baselines3 model, whose ``data`` is JSON; tanh by default.

    Objects in it are pickled. Only the text representations next to them are read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        name = str((data.get("policy_kwargs") or {}).get("activation_fn", "Tanh"))
    except Exception:  # damaged in one of many ways: the caller names the activation
        return None
    word = re.search(r"(\w+)\W*$", name)  # <class 'torch.nn.modules.activation.ReLU'>
    return word[1].lower() if word else None


def _read_sb3(path: Path | str) -> Arrays:
    """The parameters of the policy of a Stable-Baselines3 model, by name."""
    _library(path, "torch", "sb3")
    files = _library(path, "stable_baselines3", "sb3").common.save_util
    with _loading(path, "a model of Stable-Baselines3") as stream:
        _, parameters, _ = files.load_from_zip_file(stream, load_data=False, device="cpu")
        return _to_arrays(parameters.get("policy", {}))


def _read_state_dict(path: Path | str) -> Arrays:
    """The tensors of a state dict that ``torch.save`` wrote, by name, in their order."""
    torch = _library(path, "torch", "torch")
    with _loading(path, "a state dict of PyTorch") as stream:
        tensors = torch.load(stream, map_location="cpu", weights_only=True)
        for key in ("state_dict", "model_state_dict"):  # of a checkpoint
            tensors = tensors.get(key, tensors)
        return _to_arrays(tensors)


def _library(path: Path | str, module: str, extra: str) -> Any:
    """A library that loads a file, in a version that executes nothing in it.

    Raises:
        InputError: it is not installed, or too old.
    """
    name, least = LIBRARIES[module]
    try:
        library = importlib.import_module(module)
        found = re.match(r"(\d+)\.(\d+)", library.__version__)
    except ImportError:
        found = None
    if found is None or tuple(map(int, found.groups())) < least:
        version = ".".join(map(str, least))
        raise InputError(
            f"{path}: this needs {name} {version} or newer: pip install 'quadjax[{extra}]'"
        )
    return library


@contextlib.contextmanager
def _loading(path: Path | str, what: str) -> Iterator[BinaryIO]:
    """The stream of a file that a library loads in the block, with its errors in one line.

    Their text is left out: PyTorch's recommends unpickling the file.
    """
    with reading(path), open(path, "rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield stream
        except Exception:  # of many kinds for a damaged file
            raise InputError(
                f"{path}: not {what}: damaged, or with objects other than named tensors, such as a "
                "whole module instead of its state_dict()"
            ) from None


def _to_arrays(tensors: Mapping[str, Any]) -> Arrays:
    """Tensors of any floating type as arrays in double precision."""
    return {str(name): tensor.detach().double().numpy() for name, tensor in tensors.items()}


def read_c(path: Path | str) -> Network:
    """The network of a C file, without layers where the file has only ``output_std``.

    Raises:
        InputError: a file that cannot be read, or numbers that do not fit; in one line.
    """
    arrays, text = read_arrays(path)
    std = arrays.pop(STD, None)
    if std is not None and not np.all((std > 0) & np.isfinite(std)):
        raise InputError(f"{path}: {STD} is {std.tolist()}, expected numbers above 0")
    names = [match for match in map(C_NAMES[0].fullmatch, arrays) if match]
    if len({match[1] for match in names}) > 1:
        listed = ", ".join(match[0] for match in names)
        raise InputError(f"{path}: has {listed:.80}, expected weights_fc1, biases_fc1, ..")
    forward = FORWARD.search(text)
    code = forward[1] if forward else text
    kinds = [kind for kind in ("relu", "tanh") if re.search(kind, code, re.IGNORECASE)]
    return Network(
        layers=_layers(path, arrays, C_NAMES) if arrays else (),
        log_std=None if std is None else np.log(std),
        activation=kinds[0] if len(kinds) == 1 else None,
    )
