"""The integer arithmetic of the network: quantization, dense layers, digests.

Every function takes NumPy arrays, or JAX arrays while 64-bit types are enabled; ``xp`` is the
array module where one has to be chosen.
"""

from types import ModuleType
from typing import Any

import numpy as np

Array = Any  # np.ndarray or jax.Array

INPUT_BITS = 30  # the edge of a declared range is 2^30
ONE = 2**INPUT_BITS
WORD = 32  # shift from a hidden accumulator to its output
DIGEST_START, DIGEST_FACTOR = 2166136261, 16777619  # FNV-1a over 32-bit words


def quantize(values: Array, exponents: tuple[int, ...], xp: ModuleType = np) -> Array:
    """Floats (.., k) as int64 in units of 2^-30 of their ranges ``+-2**exponent``, truncated.

    A value that is not finite becomes zero; one outside its range becomes the edge of the range.
    """
    limit = np.ldexp(1.0, np.asarray(exponents))
    single = xp.asarray(values, xp.float32)
    finite = xp.where(xp.isfinite(single), single, xp.float32(0)).astype(xp.float64)
    return xp.trunc(xp.clip(finite, -limit, limit) * (ONE / limit)).astype(xp.int64)


def dense(inputs: Array, weights: np.ndarray, bias: np.ndarray, xp: ModuleType = np) -> Array:
    """Accumulators (.., rows) int64 of inputs (.., columns) int64."""
    return inputs @ xp.asarray(weights.T.astype(np.int64)) + xp.asarray(bias)


def hidden_output(sums: Array, xp: ModuleType = np) -> Array:
    """ReLU, rounding and rescaling of hidden accumulators: the upper word, or zero."""
    return xp.maximum(sums >> WORD, 0)


def digest(values: np.ndarray) -> np.ndarray:
    """FNV-1a digest (n,) uint32 of int64 (n, k) as in the C, low word before high word."""
    value = np.full(len(values), DIGEST_START, np.uint32)
    words = np.ascontiguousarray(values, np.int64).view(np.uint32).reshape(len(values), -1)
    for column in words.T:
        value = (value ^ column) * np.uint32(DIGEST_FACTOR)
    return value


def hash_words(words: np.ndarray) -> int:
    """FNV-1a hash of 32-bit words (n,), as ``hash_of`` in C."""
    value = DIGEST_START
    for word in words.tolist():
        value = ((value ^ word) * DIGEST_FACTOR) & 0xFFFFFFFF
    return value
