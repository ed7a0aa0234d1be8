"""Arrays of networks in C source, which is read as text."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_text

Arrays = Mapping[str, np.ndarray]
STD = "output_std"
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
ARRAY = re.compile(r"\b(?:float|double)\s+(\w+)\s*((?:\[[^\]]*\]\s*)+)[^={;]*=\s*\{([^;]*)\}\s*;")
# The names of a layer's weights, and of its biases.
C_NAMES = re.compile(r"(\w*?)weights_(\w+)"), r"\1biases_\2"
READ = re.compile(rf"\w*?(?:weights|biases)_\w+|{STD}")


def read_arrays(path: Path | str) -> tuple[dict[str, np.ndarray], str]:
    """The arrays of networks in a C file by name, and its text without comments.

    ``const float weights_fc1[64*20] = {0.1f, ..};`` with a row for each output. Weights in two
    dimensions, ``[64][20]``, may also have a row for each input. The number of entries must be
    that of the declaration, where it consists of plain numbers.
    """
    text = COMMENT.sub(" ", read_text(path))
    arrays: dict[str, np.ndarray] = {}
    for name, sizes, body in ARRAY.findall(text):
        if not READ.fullmatch(name):
            continue
        words = re.sub(r"[,{}]", " ", body).split()
        try:
            numbers = np.array([float(word.rstrip("fF")) for word in words], np.float64)
        except ValueError as error:
            raise InputError(f"{path}: {name}: {str(error):.80}, expected numbers") from None
        declared = [_product(size) for size in re.findall(r"\[([^\]]*)\]", sizes)]
        count = math.prod(size or 0 for size in declared)
        if None not in declared and count != len(words):
            raise InputError(
                f"{path}: {name} has {len(words)} numbers, its declaration says {count}"
            )
        arrays[name] = numbers
        if re.fullmatch(C_NAMES[0], name) and len(declared) > 1:
            arrays[name] = numbers.reshape(_shape(f"{path}: {name}", declared, body, len(words)))
    if not arrays:
        raise InputError(f"{path}: no array weights_.. or {STD}, expected such as weights_fc1[]")
    return _by_output(path, arrays), text


def _by_output(path: Path | str, arrays: Arrays) -> dict[str, np.ndarray]:
    """The arrays of a C file with a row for each output, also where they have one for each input.

    The biases tell which; square weights follow the others.
    """
    outputs = {
        name: arrays[bias].size
        for name, bias in pairs(arrays, C_NAMES).items()
        if bias in arrays and arrays[name].ndim == 2
    }
    square = [name for name in outputs if len(set(arrays[name].shape)) == 1]
    others = {arrays[name].shape[0] == outputs[name] for name in outputs if name not in square}
    if square and len(others) != 1:
        name = min(square)
        raise InputError(
            f"{path}: {name} is square, and no other layer tells whether its rows are inputs or "
            f"outputs, expected {name}[{arrays[name].size}] with a row for each output"
        )
    of_inputs = [name for name, count in outputs.items() if arrays[name].shape[1] == count]
    turned = [] if others == {True} else of_inputs
    return {name: array.T if name in turned else array for name, array in arrays.items()}


def _product(size: str) -> int | None:
    """The number of a size such as ``64*20``; None where it is not of plain numbers."""
    factors = [factor.strip() for factor in size.split("*")]
    return math.prod(map(int, factors)) if all(map(str.isdecimal, factors)) else None


def _shape(where: str, declared: Sequence[int | None], body: str, count: int) -> tuple[int, int]:
    """The shape of ``count`` numbers, by the declared sizes, or by inner braces where they lack."""
    rows = {len(row.split(",")) for row in re.findall(r"\{([^{}]*?),?\s*\}", body)}
    columns = declared[-1] or (count // declared[0] if declared[0] else max(rows, default=0))
    if len(declared) > 2 or len(rows) > 1 or not columns or count % columns:
        allowed = "rows of equal length, as [64][20] = {{..}, ..}"
        raise InputError(f"{where} has other dimensions than are read, expected {allowed}")
    return count // columns, columns


def pairs(arrays: Arrays, names: tuple[re.Pattern[str], str]) -> dict[str, str]:
    """The names of weights, in their order, and those of their biases."""
    matches = [match for match in map(names[0].fullmatch, arrays) if match]
    return {match[0]: match.expand(names[1]) for match in matches}
