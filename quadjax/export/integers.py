"""Integer arithmetic of the emulators: quantization, rounding shifts, dense layers, digests.

Every function takes NumPy arrays, or JAX arrays while 64-bit types are enabled; ``xp`` is the
array module where one has to be chosen.
"""

import dataclasses
import math
from types import ModuleType
from typing import Any

import numpy as np

Array = Any  # np.ndarray or jax.Array

INPUT_BITS = 30  # the edge of a declared range is 2^30
ONE = 2**INPUT_BITS
WORD = 32  # shift from a hidden accumulator to its output
SPLIT = 16  # a long product is made of an upper part and 16 lower bits
DIGEST_START, DIGEST_FACTOR = 2166136261, 16777619  # FNV-1a over 32-bit words


def quantize(values: Array, exponents: tuple[int, ...], xp: ModuleType = np) -> Array:
    """Floats (.., k) as int64 in units of 2^-30 of their ranges ``+-2**exponent``, truncated.

    NaN becomes zero; a value outside its range becomes the edge of the range.
    """
    limit = np.ldexp(1.0, np.asarray(exponents))
    single = xp.asarray(values, xp.float32)
    finite = xp.where(xp.isnan(single), xp.float32(0), single).astype(xp.float64)
    return xp.trunc(xp.clip(finite, -limit, limit) * (ONE / limit)).astype(xp.int64)


def status_masks(values: np.ndarray, exponents: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Bit masks (n,) uint32 of floats (n, k): bit i if value i is clipped, and if it is NaN."""
    single = np.asarray(values, np.float32)
    nan = np.isnan(single)
    clipped = np.abs(np.where(nan, np.float32(0), single)) > np.ldexp(1.0, np.asarray(exponents))
    return bit_mask(clipped), bit_mask(nan)


def bit_mask(flags: np.ndarray) -> np.ndarray:
    """Flags (n, k) as masks (n,) uint32, bit i for column i and bit 31 for all from there on."""
    bits = np.uint32(1) << np.minimum(np.arange(flags.shape[1]), 31).astype(np.uint32)
    return np.bitwise_or.reduce(flags * bits, axis=1, initial=np.uint32(0))


def round_shift(value: Array, shift: int) -> Array:
    """``value / 2**shift`` to the nearest integer, halves up; a negative shift multiplies."""
    if shift <= 0:
        return value << -shift
    return (value + (1 << (shift - 1))) >> shift


def multiply_shift(value: np.ndarray, factor: Array, shift: int) -> np.ndarray:
    """``value * factor / 2**shift`` to the nearest integer, of values too long for one product."""
    upper, lower = value >> SPLIT, value & ((1 << SPLIT) - 1)
    return round_shift(upper * factor + ((lower * factor) >> SPLIT), shift - SPLIT)


@dataclasses.dataclass(frozen=True)
class Rescale:
    """A linear map of integers: ``(q - middle) factor >> shift``, rounded."""

    middle: int
    factor: int  # below 2^31
    shift: int

    @classmethod
    def of(cls, middle: float, factor: float) -> "Rescale":
        """Integers of ``(q - middle) factor``, the factor with 30 bits."""
        shift = 30 - math.frexp(factor)[1]
        return cls(round(middle), round(factor * 2.0**shift), shift)

    def apply(self, q: np.ndarray) -> np.ndarray:
        """The map of integers (..)."""
        return round_shift((q - self.middle) * self.factor, self.shift)


def dense(inputs: Array, weights: np.ndarray, bias: np.ndarray, xp: ModuleType = np) -> Array:
    """Accumulators (.., rows) int64 of inputs (.., columns) int64."""
    return inputs @ xp.asarray(weights.T.astype(np.int64)) + xp.asarray(bias)


def hidden_output(sums: Array, xp: ModuleType = np) -> Array:
    """ReLU, rounding and rescaling of hidden accumulators: the upper word, or zero."""
    return xp.maximum(sums >> WORD, 0)


def digest(values: np.ndarray) -> np.ndarray:
    """FNV-1a digest (n,) uint32 of int64 (n, k) as in the C, low word before high word."""
    wide = np.asarray(values, np.int64)
    words = np.stack([wide & 0xFFFFFFFF, (wide >> 32) & 0xFFFFFFFF], axis=-1)
    return word_digest(words.reshape(len(wide), -1))


def word_digest(words: np.ndarray) -> np.ndarray:
    """FNV-1a digest (n,) uint32 of 32-bit words (n, k)."""
    value = np.full(len(words), DIGEST_START, np.uint32)
    for column in words.astype(np.uint32).T:
        value = (value ^ column) * np.uint32(DIGEST_FACTOR)
    return value
