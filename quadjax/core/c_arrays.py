"""Arrays of floats in C source, read as text."""

import math
import re
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_text

COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
ARRAY = re.compile(r"\b(?:float|double)\s+(\w+)\s*((?:\[[^\]]*\]\s*)+)[^={;]*=\s*\{([^;]*)\}\s*;")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?[fF]?")


def read_c_arrays(path: Path | str) -> tuple[dict[str, np.ndarray], str]:
    """The arrays of floats that a C file defines, by name, flat, and its text without comments.

    ``const float weights_fc1[64*20] = {0.1f, ..};`` and arrays in several dimensions. Nothing is
    compiled.

    Raises:
        InputError: no text, no array, an entry that is no number, or fewer or more entries than the
            declaration says; in one line.
    """
    text = COMMENT.sub(" ", read_text(path))
    arrays: dict[str, np.ndarray] = {}
    for name, sizes, body in ARRAY.findall(text):
        arrays[name] = _values(path, name, body)
        declared = [_size(part) for part in re.findall(r"\[([^\]]*)\]", sizes)]
        count = None if None in declared else math.prod(size for size in declared if size)
        if count is not None and len(arrays[name]) != count:
            raise InputError(
                f"{path}: {name} has {len(arrays[name])} numbers, its declaration says {count}"
            )
    if not arrays:
        raise InputError(f"{path}: no array of floats, expected such as weights_fc1[] = {{..}};")
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
