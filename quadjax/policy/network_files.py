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
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from quadjax.core import contents
from quadjax.core.contents import check_kind
from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file, read_layers
from quadjax.policy.c_arrays import C_NAMES, STD, Arrays, pairs, read_arrays

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # (kernel (in, out), bias (out,)) of each
C, TORCH, SB3 = (".c", ".h", ".cpp", ".hpp"), (".pt", ".pth", ".ckpt"), (".zip",)
SUFFIXES = (*SB3, *TORCH, *C)
ASSUMED = (  # of every network, as no file says it
    "assumed: the network observes what the race gives, without statistics of its own (VecNormalize"
    ", a running mean), and its outputs are clipped to [-1, 1], the range of the commands"
)
STATISTICS = re.compile(
    r"(?i)(?!.*(rew|\bret))(.*(norm|rms|running|scaler)|.*(obs|input).*(mean|std|var))"
)
FOLD = (
    "statistics of the inputs, which a policy file cannot have: fold them into the first layer "
    "(weight / std, bias - weight @ (mean / std))"
)
LIBRARIES = {  # name, and the first version that executes nothing in a file
    "torch": ("PyTorch", (2, 6)),
    "stable_baselines3": ("Stable-Baselines3", (2, 8)),
}
SB3_PARTS = "policy_kwargs", "action_space"  # of its data
SB3_POLICY, SB3_VALUE = "mlp_extractor.policy_net.", "mlp_extractor.value_net."
TORCH_NAMES = re.compile(r"(.*)weight"), r"\1bias"
FORWARD = re.compile(r"forward\s*\([^)]*\)\s*\{([^{}]*)\}")
CALLED = re.compile(r"(?i)\b(\w*(?:elu|tanh|sigmoid)\w*)\s*\(")
KNOWN = re.compile(r"(?i)(?!.*(?:leaky|hard))(?:.*[^a-z])?(relu|tanh)f?")


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
    - ``.pt``, ``.pth``, ``.ckpt``: a state dict, by PyTorch, of Stable-Baselines3's policy or of
      linear layers in the order of their application, optionally with ``log_std``;
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
        check_kind(path, "a state dict of PyTorch", contents.TORCH, contents.PICKLE)
        return _of_tensors(path, _read_state_dict(path))
    check_kind(path, "a model of Stable-Baselines3", contents.SB3)
    tensors = _read_sb3(path)
    if not any(name.startswith(SB3_POLICY) for name in tensors):
        raise InputError(f"{path}: no {SB3_POLICY}*, expected a model of PPO or A2C with MlpPolicy")
    network, activation = _of_tensors(path, tensors), _sb3_activation(path, _sb3_data(path))
    return dataclasses.replace(network, activation=activation)


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
    if others := sorted(set(arrays) - {*used, *used.values()}):
        _refuse_statistics(path, others)
        raise InputError(
            f"{path}: {others[0]} does not belong to a linear layer, expected only linear layers"
        )
    numbered: dict[str, np.ndarray] = {}
    for index, (name, bias) in enumerate(used.items()):
        rows, shape = arrays[bias].size if bias in arrays else 0, arrays[name].shape
        flat = len(shape) == 1 and names is C_NAMES
        if not rows or arrays[name].size % rows or not (flat or shape[:-1] == (rows,)):
            raise InputError(f"{path}: {name} has no {bias} with a number for each of its rows")
        numbered[f"kernel_{index}"] = arrays[name].reshape(rows, -1).T
        numbered[f"bias_{index}"] = arrays[bias]
    layers = read_layers(path, numbered)
    return tuple((kernel.astype(np.float32), bias.astype(np.float32)) for kernel, bias in layers)


def _refuse_statistics(path: Path | str, names: Iterable[str]) -> None:
    """Reject a file with statistics that normalize the observation, by the names of its parts."""
    for name in filter(STATISTICS.match, names):
        raise InputError(f"{path}: has {name}, {FOLD}")


def _sb3_data(path: Path | str) -> dict[str, Any]:
    """What a Stable-Baselines3 model says of itself, as far as it is JSON.

    Objects in it are pickled. Only the text representations next to them are read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(json.loads(archive.read("data")))
    except Exception:  # damaged in one of many ways: the caller names the activation
        return {}


def _sb3_activation(path: Path | str, data: Mapping[str, Any]) -> str | None:
    """The activation of a Stable-Baselines3 model, by default tanh.

    Raises:
        InputError: a policy that does more than its layers and a clip to [-1, 1].
    """
    kwargs, space = (x if isinstance(x, dict) else {} for x in map(data.get, SB3_PARTS))
    extractor = str(kwargs.get("features_extractor_class", "FlattenExtractor"))
    for ends, limit in (("low", -1.0), ("high", 1.0)):
        numbers = re.findall(r"[-+.\w]+", str(space.get(ends, "")))
        if any(number not in (f"{limit:g}", f"{limit:g}.", f"{limit:.1f}") for number in numbers):
            expected = f"{limit:g} of every action (gymnasium.wrappers.RescaleAction)"
            raise InputError(f"{path}: action_space.{ends} is {space[ends]}, expected {expected}")
    if "FlattenExtractor" not in extractor:
        raise InputError(f"{path}: features_extractor_class is {extractor}, expected none")
    if kwargs.get("squash_output"):
        raise InputError(f"{path}: squash_output is true, expected actions that are clipped")
    if not data:
        return None
    word = re.search(r"(\w+)\W*$", str(kwargs.get("activation_fn", "Tanh")))
    return word[1].lower() if word else None  # <class 'torch.nn.modules.activation.ReLU'>


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
        others: list[str] = []
        for key in ("state_dict", "model_state_dict"):  # of a checkpoint
            if key in tensors:
                others += [str(x) for x in tensors if not isinstance(tensors[x], int | float)]
                tensors = tensors[key]
        arrays = _to_arrays(tensors)
    _refuse_statistics(path, others)
    return arrays


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
    layers = _layers(path, arrays, C_NAMES) if arrays else ()
    activation = _c_activation(path, text, len(layers)) if layers else None
    return Network(layers, None if std is None else np.log(std), activation)


def _c_activation(path: Path | str, text: str, layers: int) -> str | None:
    """The activation that ``..forward`` calls, or the only one in the text of a C file."""
    forward = FORWARD.search(text)
    called = CALLED.findall(forward[1] if forward else text)
    known = [(name, KNOWN.fullmatch(name)) for name in called]
    kinds = sorted({match[1].lower() if match else name for name, match in known})
    if forward and called and (len(kinds) > 1 or len(called) >= layers):
        allowed = f"one activation of the {layers - 1} hidden layers and none of the output"
        raise InputError(f"{path}: ..forward calls {', '.join(called):.80}, expected {allowed}")
    return kinds[0] if len(kinds) == 1 else None
