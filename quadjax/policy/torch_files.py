"""PyTorch state dicts as NumPy arrays, without PyTorch and without executing anything.

A state dict is a pickle of names, shapes and references to raw data, in a zip archive. The reader
loads only the names that such a pickle needs (an ordered dict, the two functions that make a
tensor, the types of storage) and rejects all others, so a file cannot run code.
"""

import collections
import dataclasses
import io
import math
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file, read_layers

MAX_BYTES = 2**28  # of one file
STORAGES = {
    "FloatStorage": np.float32,
    "DoubleStorage": np.float64,
    "HalfStorage": np.float16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}
LEGACY = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."  # magic number of torch.save before 1.6
ERRORS = (
    *(pickle.UnpicklingError, zipfile.BadZipFile, EOFError, KeyError, ValueError, TypeError),
    *(AttributeError, IndexError, NotImplementedError, OverflowError, MemoryError, RecursionError),
    *(ImportError, RuntimeError, UnicodeError, AssertionError),
)


@dataclasses.dataclass(frozen=True)
class _Storage:
    values: np.ndarray  # (n,)


def read_state_dict(path: Path | str, member: str | None = None) -> dict[str, np.ndarray]:
    """The tensors of a state dict that ``torch.save`` wrote, by name, in their order.

    Args:
        path: a ``.pt`` or ``.pth`` file.
        member: a file of that format inside the zip archive ``path``, such as ``policy.pth``.

    Raises:
        InputError: a missing or damaged file, the legacy format, a file that holds other objects
            than tensors by name, or anything that would have to be executed; in one line.
    """
    check_file(path)
    name = f"{path}: {member}" if member else str(path)
    with reading(path):
        data = Path(path).read_bytes() if Path(path).stat().st_size <= MAX_BYTES else b""
    try:
        if member is not None:
            data = _member(zipfile.ZipFile(io.BytesIO(data)), member)
        if data.startswith(LEGACY):
            raise InputError(
                f"{name}: in PyTorch's legacy format, expected the zip format: load it and save it "
                "again with torch.save"
            )
        return _tensors(_Archive(io.BytesIO(data)).load(), name)
    except InputError:
        raise
    except ERRORS as error:
        detail = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{name}: not a PyTorch state dict ({detail:.120})") from error


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A file of an archive; its size is checked before it is unpacked."""
    if archive.getinfo(name).file_size > MAX_BYTES:
        raise ValueError(f"{name} has more than {MAX_BYTES} bytes")
    return archive.read(name)


class _Archive:
    """The zip archive of one ``torch.save``."""

    def __init__(self, stream: BinaryIO) -> None:
        self._zip = zipfile.ZipFile(stream)
        found = [name for name in self._zip.namelist() if name.endswith("data.pkl")]
        if len(found) != 1:
            raise ValueError(f"{len(found)} entries data.pkl, expected one")
        self._folder = found[0].removesuffix("data.pkl")
        order = f"{self._folder}byteorder"
        if order in self._zip.namelist() and _member(self._zip, order) != b"little":
            raise ValueError("byte order is not little-endian")

    def load(self) -> object:
        """The pickled object, with arrays for tensors."""
        data = _member(self._zip, f"{self._folder}data.pkl")
        return _Unpickler(io.BytesIO(data), self.storage).load()

    def storage(self, kind: object, key: object, count: object) -> _Storage:
        """The raw numbers that a tensor refers to."""
        if not isinstance(kind, np.dtype) or not isinstance(key, str):
            raise ValueError("a storage of an unknown type")
        values = np.frombuffer(_member(self._zip, f"{self._folder}data/{key}"), kind)
        if len(values) != count:
            raise ValueError(f"storage {key} has {len(values)} numbers, expected {count}")
        return _Storage(values)


class _Unpickler(pickle.Unpickler):
    """An unpickler that knows tensors and ordered dicts only."""

    def __init__(self, stream: BinaryIO, storage: Any) -> None:
        super().__init__(stream, encoding="utf-8")
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        """The few names that a state dict refers to; no other is imported."""
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _parameter
        if module == "torch" and name in STORAGES:
            return np.dtype(STORAGES[name])
        raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not loaded")

    def persistent_load(self, pid: Any) -> _Storage:
        """A storage: ("storage", type, key, device, number of elements)."""
        kind, dtype, key, _, count = pid
        if kind != "storage":
            raise pickle.UnpicklingError(f"it refers to {kind!r:.40}")
        return self._storage(dtype, key, count)


def _tensor(storage: Any, offset: int, size: Any, stride: Any, *_: object) -> np.ndarray:
    """The array of a tensor, which must lie within its storage."""
    if not isinstance(storage, _Storage):
        raise pickle.UnpicklingError("a tensor without storage")
    values, numbers = storage.values, (offset, *size, *stride)
    if len(size) != len(stride) or any(type(n) is not int or n < 0 for n in numbers):
        raise pickle.UnpicklingError("a tensor with an impossible shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) > len(values) or (math.prod(size) and last >= len(values)):
        raise pickle.UnpicklingError("a tensor larger than its storage")
    steps = [step * values.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(values[offset:], size, steps).copy()


def _parameter(data: np.ndarray, *_: object) -> np.ndarray:
    return data


def _tensors(found: object, name: str) -> dict[str, np.ndarray]:
    """The state dict, also where it is the entry ``state_dict`` of a checkpoint."""
    for key in ("state_dict", "model_state_dict"):
        if isinstance(found, Mapping) and isinstance(found.get(key), Mapping):
            found = found[key]
    if not isinstance(found, Mapping) or not found:
        raise InputError(f"{name}: holds a {type(found).__name__}, expected tensors by name")
    for key, value in found.items():
        if not isinstance(key, str) or not isinstance(value, np.ndarray):
            raise InputError(f"{name}: {key!r:.60} is no tensor, expected a state dict")
    return dict(found)


Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # (kernel (in, out), bias (out,)) of each


def single(layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> Layers:
    """Layers in single precision."""
    return tuple((kernel.astype(np.float32), bias.astype(np.float32)) for kernel, bias in layers)


def linear_layers(path: Path | str, tensors: Mapping[str, np.ndarray]) -> Layers:
    """Linear layers, in the order of the file: ``NAME.weight`` (out, in) and ``NAME.bias`` of each.

    Raises:
        InputError: no layer, a tensor of another kind, or layers that do not fit to each other.
    """
    arrays: dict[str, np.ndarray] = {}
    weights = [name for name in tensors if name.endswith("weight")]
    biases = {name.removesuffix("weight") + "bias" for name in weights}
    for name in tensors:
        if name not in weights and name not in biases:
            raise InputError(f"{path}: {name} is not of a linear layer, expected only those")
    for index, name in enumerate(weights):
        bias = name.removesuffix("weight") + "bias"
        if bias not in tensors:
            raise InputError(f"{path}: {name} has no {bias}, expected linear layers with biases")
        arrays[f"kernel_{index}"] = np.transpose(tensors[name])
        arrays[f"bias_{index}"] = tensors[bias]
    if not arrays:
        raise InputError(f"{path}: no linear layer")
    return single(read_layers(path, arrays))
