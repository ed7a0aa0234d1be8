"""Atomic file writes: to a temporary file, which is then renamed."""

import contextlib
import csv
import json
import math
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.contents import EMPTY, NPZ, TEXT, check_kind
from quadjax.core.errors import InputError, reading, writing

TEMPORARY = ".writing-"  # prefix of temporary files
ARRAYS = re.compile(r"(\w+_)?(kernel|bias)_\d{1,3}|log_std|(actor|critic)(/\w+)+")  # of a file
MAX_WEIGHT = 1e6  # of a network: products over some layers stay finite in single precision
MAX_BYTES = 2**28  # of one array of an .npz file, and of a text file


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path of the same suffix; on success it becomes ``path``.

    A link is followed. The next write replaces a temporary file that a killed process left.

    Raises:
        InputError: a system error: disk full, no permission, a name that is too long; a directory,
            a pipe or a device.
    """
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f"{TEMPORARY}{path.name}")
    with writing(path):
        if path.exists():
            check_file(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            if path.exists():
                shutil.copymode(path, temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file atomically."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write a binary file atomically."""
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


def write_csv(path: Path | str, rows: Iterable[Sequence[object]]) -> None:
    """Write rows as a CSV file, atomically."""
    with (
        whole_file(path) as temporary,
        open(temporary, "w", newline="", encoding="utf-8") as stream,
    ):
        csv.writer(stream).writerows(rows)


def write_json(path: Path | str, value: object) -> None:
    """Write a JSON file atomically.

    Raises:
        ValueError: a number that is not finite; JSON has none.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path | str) -> dict[str, Any]:
    """A JSON file that holds an object.

    Raises:
        InputError: no such file, not JSON, or not an object.
    """
    return _parse_json(read_text(path), f"{path}: damaged, not JSON")


def _parse_json(text: str, label: str) -> dict[str, Any]:
    try:
        # An integer of more than 18 digits is a float, perhaps infinite.
        value = json.loads(text, parse_int=lambda x: (int if len(x) < 19 else float)(x))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{label} ({error})") from error
    if not isinstance(value, dict):
        raise InputError(f"{label} of an object")
    return value


def write_npz(path: Path | str, arrays: dict[str, np.ndarray], meta: dict[str, object]) -> None:
    """Write arrays and a JSON string ``meta`` to an ``.npz`` file, atomically, without pickles."""
    with whole_file(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, allow_pickle=False, **{**arrays, "meta": np.array(json.dumps(meta))})


def check_file(path: Path | str) -> None:
    """Raise an ``InputError`` for a path that is not a regular file (a directory, a pipe, ..)."""
    with reading(path):
        mode = Path(path).stat().st_mode
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: is a directory, expected a file")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: not a regular file")


def read_text(path: Path | str, limit: int = MAX_BYTES, empty: bool = False) -> str:
    """The text of a UTF-8 file, with or without a byte-order mark.

    Args:
        path: the file.
        limit: largest allowed size, bytes.
        empty: whether it may be empty.

    Raises:
        InputError: not a regular file, unreadable, empty or something else than text, larger, or
            not UTF-8.
    """
    check_file(path)
    check_kind(path, TEXT, TEXT, *([EMPTY] if empty else []))
    with reading(path):
        with open(path, "rb") as stream:
            data = stream.read(limit + 1)
        if len(data) > limit:
            raise InputError(f"{path}: larger than {limit:,} bytes")
        return data.decode("utf-8-sig")


def read_npz(
    path: Path | str, expected_format: str | tuple[str, ...], names: Sequence[str] = ()
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read an ``.npz`` file that ``write_npz`` or plain NumPy wrote.

    Only the arrays that the formats define are read (``kernel_N``, ``bias_N`` with any prefix,
    ``log_std``, parameters ``actor/..`` and ``critic/..``, and ``names``), and only up to
    ``MAX_BYTES`` each. Nothing is unpickled.

    Args:
        path: the file.
        expected_format: the value of ``meta["format"]``, or the allowed values.
        names: of further arrays.

    Returns:
        The arrays by name, and ``meta``.

    Raises:
        InputError: no such file, not an npz, damaged, pickled, too large, or of another format.
    """
    check_file(path)
    check_kind(path, NPZ, NPZ)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [name.removesuffix(".npy") for name in archive.namelist()]
            if twice := sorted({name for name in entries if entries.count(name) > 1}):
                raise InputError(f"{path}: {twice[0]} is in the file more than once")
            arrays = {
                name: _read_entry(path, archive, name)
                for name in entries
                if ARRAYS.fullmatch(name) or name in ("meta", *names)
            }
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for a damaged file
        raise InputError(f"{path}: not a readable .npz file ({str(error)[:200]})") from error
    if "meta" not in arrays:
        raise InputError(f"{path}: no 'meta' entry; expected a JSON string")
    meta = _parse_json(str(arrays.pop("meta")), f"{path}: 'meta' is not JSON")
    stated = meta.get("format")
    formats = (expected_format,) if isinstance(expected_format, str) else expected_format
    if stated not in formats:
        raise InputError(f"{path}: format is {stated!r}, expected {' or '.join(formats)}")
    return arrays, meta


def _read_entry(path: Path | str, archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array of an ``.npz`` file, after a look at the size in its header."""
    headers = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    with archive.open(f"{name}.npy") as stream:
        version = np.lib.format.read_magic(stream)[0]  # 3 differs from 2 by names in UTF-8
        shape, _, dtype = headers.get(version, headers[2])(stream)
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_BYTES:
        raise InputError(f"{path}: {name} has {size:,} bytes, allowed: up to {MAX_BYTES:,}")
    with archive.open(f"{name}.npy") as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def read_layers(
    path: Path | str, arrays: dict[str, np.ndarray], prefix: str = ""
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The dense layers ``{prefix}kernel_0, {prefix}bias_0, ..`` of a file, checked to fit.

    Raises:
        InputError: a missing or misshapen array, or a number in one that is not finite or above
            ``MAX_WEIGHT``, by name.
    """
    layers: list[tuple[np.ndarray, np.ndarray]] = []
    inputs: int | None = None
    while not layers or f"{prefix}kernel_{len(layers)}" in arrays:
        names = [f"{prefix}{kind}_{len(layers)}" for kind in ("kernel", "bias")]
        if missing := [name for name in names if name not in arrays]:
            raise InputError(f"{path}: {missing[0]} is missing")
        kernel, bias = (arrays[name] for name in names)
        if kernel.ndim != 2 or 0 in kernel.shape or inputs not in (None, kernel.shape[0]):
            expected = f"({inputs or 'in'}, out)"
            raise InputError(f"{path}: {names[0]} has shape {kernel.shape}, expected {expected}")
        inputs = kernel.shape[1]
        if bias.shape != (inputs,):
            raise InputError(f"{path}: {names[1]} has shape {bias.shape}, expected ({inputs},)")
        for name in names:
            check_finite(path, name, arrays[name], layer=len(layers))
            if (largest := np.abs(arrays[name]).max()) > MAX_WEIGHT:
                raise InputError(f"{path}: {name} has {largest:g}, allowed: up to {MAX_WEIGHT:g}")
        layers.append((kernel, bias))
    return layers


def check_finite(path: Path | str, name: str, array: np.ndarray, layer: int | None = None) -> None:
    """Raise an ``InputError`` that names the first entry that is not finite in single precision.

    Of a layer's kernel (in, out) or bias (out,) it names layer and row too, a row being an output.
    """
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {name} holds {array.dtype}, expected numbers")
    with np.errstate(over="ignore"):
        bad = np.argwhere(~np.isfinite(array.astype(np.float32)))
    if bad.size:
        index = tuple(int(i) for i in bad[0])
        row = "" if layer is None else f"layer {layer}, row {index[-1]}: "
        raise InputError(
            f"{path}: {row}{name}{list(index)} is {array[index]}, expected a finite float32"
        )
