"""Networks in C source: arrays of floats, read as text. Nothing is compiled."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_layers, read_text
from quadjax.policy.torch_files import Layers, single

SUFFIXES = (".c", ".h", ".cpp", ".hpp")
STD = "output_std"

COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
ARRAY = re.compile(r"\b(?:float|double)\s+(\w+)\s*((?:\[[^\]]*\]\s*)+)[^={;]*=\s*\{([^;]*)\}\s*;")
WEIGHTS = re.compile(r"(\w*?)weights_(\w+)")
READ = re.compile(rf"\w*?(?:weights|biases)_\w+|{STD}")
FORWARD = re.compile(r"forward\s*\([^)]*\)\s*\{([^{}]*)\}")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?[fF]?")


@dataclasses.dataclass(frozen=True)
class CNetwork:
    """A network in C source.

    Attributes:
        layers: kernel (in, out) and bias (out,) of each.
        activation: "relu" or "tanh"; None where the source does not say.
        std: (n,) standard deviations of the outputs' noise; None where there are none.
    """

    layers: Layers
    activation: str | None
    std: np.ndarray | None


def is_c(path: Path | str) -> bool:
    """Whether a path has the suffix of C source."""
    return Path(path).suffix.lower() in SUFFIXES


def read_c_network(path: Path | str) -> CNetwork:
    """The network of a C file.

    It has arrays ``weights_NAME`` (row by row, a row per output) and ``biases_NAME`` in the order
    of the layers, with any prefix, and may have ``output_std``. The activation is the one that the
    function ``..forward`` calls, or the only one in the file.

    Raises:
        InputError: no such arrays, arrays that do not fit to each other, or an entry that is no
            number; in one line.
    """
    defined, text = _read_arrays(path)
    arrays: dict[str, np.ndarray] = {}
    names = [match for match in map(WEIGHTS.fullmatch, defined) if match]
    for index, match in enumerate(names):
        weights, name = defined[match[0]], f"{match[1]}biases_{match[2]}"
        bias = defined.get(name)
        if bias is None or not bias.size or weights.size % bias.size:
            count = "no" if bias is None else bias.size
            raise InputError(
                f"{path}: {match[0]} has {weights.size} numbers and {count} {name}, "
                "expected a row of weights for each"
            )
        arrays[f"kernel_{index}"] = weights.reshape(bias.size, -1).T
        arrays[f"bias_{index}"] = bias
    if len({match[1] for match in names}) != 1:
        listed = ", ".join(match[0] for match in names) or "no weights_.."
        raise InputError(f"{path}: has {listed:.80}, expected weights_fc1, biases_fc1, ..")
    forward = FORWARD.search(text)
    code = forward[1] if forward else text
    kinds = [kind for kind in ("relu", "tanh") if re.search(kind, code, re.IGNORECASE)]
    layers = single(read_layers(path, arrays))
    return CNetwork(layers, kinds[0] if len(kinds) == 1 else None, _std(path, defined))


def read_c_std(path: Path | str) -> np.ndarray | None:
    """The array ``output_std`` of a C file without a network; None for any other C file.

    Raises:
        InputError: a file that cannot be read, or numbers that are not above 0; in one line.
    """
    defined, _ = _read_arrays(path)
    return None if any(map(WEIGHTS.fullmatch, defined)) else _std(path, defined)


def _std(path: Path | str, arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    std = arrays.get(STD)
    if std is not None and not np.all((std > 0) & np.isfinite(std)):
        raise InputError(f"{path}: {STD} is {std.tolist()}, expected numbers above 0")
    return std


def _read_arrays(path: Path | str) -> tuple[dict[str, np.ndarray], str]:
    """The arrays of networks that a C file defines, by name, flat, and its text without comments.

    ``const float weights_fc1[64*20] = {0.1f, ..};`` and arrays in several dimensions; arrays of
    other names are not read.

    Raises:
        InputError: no text, no array, an entry that is no number, or fewer or more entries than the
            declaration says; in one line.
    """
    text = COMMENT.sub(" ", read_text(path))
    arrays: dict[str, np.ndarray] = {}
    for name, sizes, body in ARRAY.findall(text):
        if not READ.fullmatch(name):
            continue
        arrays[name] = _values(path, name, body)
        declared = [_size(part) for part in re.findall(r"\[([^\]]*)\]", sizes)]
        count = None if None in declared else math.prod(size for size in declared if size)
        if count is not None and len(arrays[name]) != count:
            raise InputError(
                f"{path}: {name} has {len(arrays[name])} numbers, its declaration says {count}"
            )
    if not arrays:
        raise InputError(f"{path}: no array weights_.. or {STD}, expected such as weights_fc1[]")
    return arrays, text


def _size(text: str) -> int | None:
    """A declared size: an integer or a product of integers; None for anything else."""
    parts = [part.strip() for part in text.split("*")]
    return math.prod(map(int, parts)) if all(part.isdecimal() for part in parts) else None


def _values(path: Path | str, name: str, body: str) -> np.ndarray:
    words = [word for word in re.split(r"[\s,{}]+", body) if word]
    for index, word in enumerate(words):
        if not NUMBER.fullmatch(word):
            raise InputError(f"{path}: {name}[{index}] is {word!r:.40}, expected a number")
    return np.array([float(word.rstrip("fF")) for word in words], np.float64)
