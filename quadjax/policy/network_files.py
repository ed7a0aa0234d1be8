"""Networks in files of other projects: Stable-Baselines3, PyTorch state dicts, C arrays.

Nothing in such a file is executed. A state dict is a pickle of names, shapes and references to raw
data in a zip archive; the reader loads only the names that it needs and rejects all others. C is
read as text.
"""

import collections
import dataclasses
import io
import json
import math
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import is_zip, read_layers, read_text

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # (kernel (in, out), bias (out,)) of each
Arrays = Mapping[str, np.ndarray]
C, TORCH, SB3 = (".c", ".h", ".cpp", ".hpp"), (".pt", ".pth"), (".zip",)
SUFFIXES = (*SB3, *TORCH, *C)
MAX_BYTES = 2**28  # of an entry of an archive
SB3_POLICY, SB3_VALUE = "mlp_extractor.policy_net.", "mlp_extractor.value_net."
STD = "output_std"
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
ARRAY = re.compile(r"\b(?:float|double)\s+(\w+)\s*((?:\[[^\]]*\]\s*)+)[^={;]*=\s*\{([^;]*)\}\s*;")
# The names of a layer's weights, and of its biases.
C_NAMES = re.compile(r"(\w*?)weights_(\w+)"), r"\1biases_\2"
TORCH_NAMES = re.compile(r"(.*)weight"), r"\1bias"
READ = re.compile(rf"\w*?(?:weights|biases)_\w+|{STD}")
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

    - ``.zip``: a model of Stable-Baselines3 (PPO or A2C, ``MlpPolicy``);
    - ``.pt``, ``.pth``: a PyTorch state dict, of Stable-Baselines3's policy or of linear layers in
      the order of their application, optionally with ``log_std``;
    - ``.c``, ``.h``, ``.cpp``, ``.hpp``: arrays ``weights_NAME`` (row by row, a row per output) and
      ``biases_NAME`` in the order of the layers, with any prefix, and optionally ``output_std``.
      The activation is the one that the function ``..forward`` calls, or the only one in the file.

    Raises:
        InputError: another suffix, or a file that cannot be read; in one line.
    """
    suffix = Path(path).suffix.lower()
    if suffix in C:
        network = read_c(path)
        if not network.layers:
            raise InputError(f"{path}: has no weights_.., expected weights_fc1, biases_fc1, ..")
        return network
    if suffix in TORCH:
        return _of_tensors(path, read_state_dict(path))
    if suffix not in SB3:
        raise InputError(f"{path}: suffix is {suffix!r}, allowed: {', '.join(SUFFIXES)}")
    tensors = read_state_dict(path, "policy.pth")
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
    weights, biases = names
    matches = [match for match in map(weights.fullmatch, arrays) if match]
    used = {match[0]: match.expand(biases) for match in matches}
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
            data = json.loads(_member(archive, "data"))
        name = str((data.get("policy_kwargs") or {}).get("activation_fn", "Tanh"))
        noise_of_state = bool(data.get("use_sde"))
    except Exception:  # damaged in one of many ways: the caller names the activation
        return None
    if noise_of_state:
        raise InputError(f"{path}: use_sde is true, expected state-independent noise")
    word = re.search(r"(\w+)\W*$", name)
    return word[1].lower() if word else None


def read_state_dict(path: Path | str, member: str | None = None) -> dict[str, np.ndarray]:
    """The tensors of a state dict that ``torch.save`` wrote, by name, in their order.

    Args:
        path: a ``.pt`` or ``.pth`` file.
        member: a file of that format inside the zip archive ``path``, such as ``policy.pth``.

    Raises:
        InputError: a missing or damaged file, the legacy format, a file that holds other objects
            than tensors by name, or anything that would have to be executed; in one line.
    """
    if not is_zip(path):
        raise InputError(
            f"{path}: not a zip archive, perhaps in the legacy format of PyTorch: load it and save "
            "it again with torch.save"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            inner = archive
            if member is not None:
                inner = zipfile.ZipFile(io.BytesIO(_member(archive, member)))
            tensors = _Unpickler(inner).load()
    except Exception as error:  # pickle and zipfile raise many kinds for a damaged file
        detail = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a PyTorch state dict ({detail:.120})") from error
    for key in ("state_dict", "model_state_dict"):  # of a checkpoint
        if isinstance(tensors, Mapping) and isinstance(tensors.get(key), Mapping):
            tensors = tensors[key]
    if not isinstance(tensors, Mapping) or not tensors:
        raise InputError(f"{path}: holds a {type(tensors).__name__}, expected tensors by name")
    for key, value in tensors.items():
        if not isinstance(key, str) or not isinstance(value, np.ndarray):
            raise InputError(f"{path}: {key!r:.60} is not a tensor, expected a state dict")
    return dict(tensors)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A file of an archive; its size is checked before it is unpacked."""
    if name not in archive.namelist():
        raise ValueError(f"the archive holds no file {name}")
    if archive.getinfo(name).file_size > MAX_BYTES:
        raise ValueError(f"{name} has more than {MAX_BYTES} bytes")
    return archive.read(name)


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: object) -> np.ndarray:
    """The array of a tensor, which must lie within its storage."""
    numbers = (offset, *size, *stride)
    if not isinstance(storage, np.ndarray) or any(type(n) is not int or n < 0 for n in numbers):
        raise ValueError("a tensor with an impossible shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if max(math.prod(size), last + 1) > storage.size:
        raise ValueError("a tensor larger than its storage")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()


class _Unpickler(pickle.Unpickler):
    """Reads the archive of one ``torch.save``, with arrays for tensors."""

    NAMES = {
        "collections.OrderedDict": collections.OrderedDict,
        "torch._utils._rebuild_tensor_v2": _tensor,
        "torch._utils._rebuild_parameter": lambda data, *_: data,
        "torch.FloatStorage": np.dtype("<f4"),
        "torch.DoubleStorage": np.dtype("<f8"),
        "torch.HalfStorage": np.dtype("<f2"),
        "torch.LongStorage": np.dtype("<i8"),
    }

    def __init__(self, archive: zipfile.ZipFile) -> None:
        names = [name for name in archive.namelist() if name.endswith("data.pkl")]
        if len(names) != 1:
            raise ValueError(f"{len(names)} entries data.pkl, expected one")
        self._archive, self._folder = archive, names[0].removesuffix("data.pkl")
        super().__init__(io.BytesIO(_member(archive, names[0])), encoding="utf-8")

    def find_class(self, module: str, name: str) -> Any:
        """The few names that a state dict refers to; no other is imported."""
        if f"{module}.{name}" not in self.NAMES:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not loaded")
        return self.NAMES[f"{module}.{name}"]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """The numbers of a storage: ("storage", type, key, device, number of elements)."""
        _, dtype, key, _, count = pid
        if not isinstance(dtype, np.dtype):
            raise pickle.UnpicklingError("a storage of an unknown type")
        values = np.frombuffer(_member(self._archive, f"{self._folder}data/{key}"), dtype)
        if len(values) != count:
            raise ValueError(f"storage {key} has {len(values)} numbers, expected {count}")
        return values


def read_c(path: Path | str) -> Network:
    """The network of a C file, without layers where the file has only ``output_std``.

    Raises:
        InputError: a file that cannot be read, or numbers that do not fit; in one line.
    """
    arrays, text = _read_arrays(path)
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


def _read_arrays(path: Path | str) -> tuple[dict[str, np.ndarray], str]:
    """The arrays of networks in a C file, by name, flat, and its text without comments.

    ``const float weights_fc1[64*20] = {0.1f, ..};`` and arrays in several dimensions. The number of
    entries must be that of the declaration, where it consists of plain numbers.
    """
    text = COMMENT.sub(" ", read_text(path))
    arrays: dict[str, np.ndarray] = {}
    for name, sizes, body in ARRAY.findall(text):
        if not READ.fullmatch(name):
            continue
        words = re.sub(r"[,{}]", " ", body).split()
        try:
            arrays[name] = np.array([float(word.rstrip("fF")) for word in words], np.float64)
        except ValueError as error:
            raise InputError(f"{path}: {name}: {str(error):.80}, expected numbers") from None
        factors = re.findall(r"[\[*]\s*([^\[\]*]*?)\s*(?=[\]*])", sizes)
        declared = math.prod(map(int, factors)) if all(map(str.isdecimal, factors)) else None
        if declared not in (None, count := len(words)):
            raise InputError(f"{path}: {name} has {count} numbers, its declaration says {declared}")
    if not arrays:
        raise InputError(f"{path}: no array weights_.. or {STD}, expected such as weights_fc1[]")
    return arrays, text
