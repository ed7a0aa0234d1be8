"""Files that appear whole or not at all: written beside their place, then renamed."""

import contextlib
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path of the same suffix; on success it becomes ``path``."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
        os.chmod(temporary, mode)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_text(path: Path | str, text: str) -> None:
    """Write a text file whole."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, value: object) -> None:
    """Write a JSON file whole; non-finite numbers are refused (JSON has none)."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_npz(path: Path | str, arrays: dict[str, np.ndarray], meta: dict[str, object]) -> None:
    """Write arrays and a JSON string ``meta`` to an ``.npz`` file, whole and without pickles."""
    with whole_file(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays, meta=np.array(json.dumps(meta)))


def check_file(path: Path | str) -> None:
    """Raise an ``InputError`` for a path that is no file, or a directory."""
    if Path(path).is_dir():
        raise InputError(f"{path}: is a directory, expected a file")
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file")


def read_npz(path: Path | str, expected_format: str) -> tuple[dict[str, np.ndarray], dict]:
    """Read an ``.npz`` file that ``write_npz`` or anybody's NumPy wrote.

    Args:
        path: the file.
        expected_format: what ``meta["format"]`` must say.

    Returns:
        The arrays by name, and ``meta``.

    Raises:
        InputError: no such file, not an npz, damaged, pickled, or of another format.
    """
    check_file(path)
    if not zipfile.is_zipfile(path):
        raise InputError(f"{path}: not an .npz file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: not a readable .npz file ({error})") from error
    except Exception as error:  # zlib.error and whatever else a damaged archive may raise
        raise InputError(f"{path}: damaged .npz file ({error})") from error
    if "meta" not in arrays:
        raise InputError(f"{path}: no 'meta' entry; expected a JSON string")
    try:
        meta = json.loads(str(arrays.pop("meta")))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: 'meta' is not JSON ({error})") from error
    found = meta.get("format") if isinstance(meta, dict) else None
    if found != expected_format:
        raise InputError(f"{path}: format is {found!r}, expected {expected_format!r}")
    return arrays, meta


def read_layers(
    path: Path | str, arrays: dict[str, np.ndarray], prefix: str = ""
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The dense layers ``{prefix}kernel_0, {prefix}bias_0, ..`` of a file, checked to fit.

    Raises:
        InputError: a missing or misshapen array, or a non-finite number in one, by name.
    """
    layers: list[tuple[np.ndarray, np.ndarray]] = []
    while f"{prefix}kernel_{len(layers)}" in arrays:
        k_name, b_name = f"{prefix}kernel_{len(layers)}", f"{prefix}bias_{len(layers)}"
        kernel = arrays[k_name]
        if b_name not in arrays:
            raise InputError(f"{path}: {b_name} is missing")
        bias = arrays[b_name]
        if kernel.ndim != 2 or 0 in kernel.shape:
            raise InputError(f"{path}: {k_name} has shape {kernel.shape}, expected (in, out)")
        if layers and layers[-1][0].shape[1] != kernel.shape[0]:
            raise InputError(
                f"{path}: {k_name} takes {kernel.shape[0]} inputs, but the layer before it "
                f"has {layers[-1][0].shape[1]} outputs"
            )
        if bias.shape != (kernel.shape[1],):
            raise InputError(
                f"{path}: {b_name} has shape {bias.shape}, expected ({kernel.shape[1]},)"
            )
        for name, array in ((k_name, kernel), (b_name, bias)):
            check_finite(path, name, array, layer=len(layers))
        layers.append((kernel, bias))
    if not layers:
        raise InputError(f"{path}: {prefix}kernel_0 is missing")
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
