"""Proof that no input can overflow: exact integer intervals.

Intervals are computed in Python's own integers from the box of inputs on. For every row
``|bias| + sum_j |w_ij| max|x_j| < 2**63``, so any order of summation is safe, and for every hidden
row ``0 <= y <= 2**30 - 1``. That holds for every input, not for a sample.
"""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.error_bound import error_bound
from quadjax.export.fixed import LARGEST_HIDDEN, FixedLayer, FixedNetwork
from quadjax.export.integers import ONE, WORD
from quadjax.policy.file import Policy

ACCUMULATOR = 2**63


@dataclasses.dataclass(frozen=True)
class RowRange:
    """Exact ranges of one row for every input in the box."""

    low: int  # of the accumulator
    high: int
    magnitude: int  # |bias| + sum |w| max|x|, which bounds every partial sum


@dataclasses.dataclass(frozen=True)
class Proof:
    """Proven properties of a network."""

    rows: tuple[tuple[RowRange, ...], ...]  # per layer
    error_bound: np.ndarray  # (outputs,) |command - real arithmetic|, in the command's unit
    inactive: tuple[int, ...]  # hidden neurons per layer that no input activates

    @property
    def accumulator_bits(self) -> list[float]:
        """Bits of the largest accumulator of each layer, out of 63."""
        return [max(math.log2(max(row.magnitude, 1)) for row in layer) for layer in self.rows]


def prove(network: FixedNetwork, policy: Policy) -> Proof:
    """Prove the ranges of a network and bound its error against the real-valued policy.

    Raises:
        InputError: a row whose accumulator may overflow or whose output may leave its range, or
            a table of the wrong shape, by layer and row.
    """
    high = np.array([ONE] * network.inputs, object)
    low = -high
    layers, inactive = [], []
    for index, layer in enumerate(network.layers):
        hidden = index < len(network.hidden)
        rows = prove_layer(index, layer, low, high, hidden)
        layers.append(rows)
        if hidden:
            low = np.array([max(0, row.low >> WORD) for row in rows], object)
            high = np.array([max(0, row.high >> WORD) for row in rows], object)
            inactive.append(int(np.sum(high == 0)))
    _prove_output(network, layers[-1])
    return Proof(tuple(layers), error_bound(network, policy), tuple(inactive))


def prove_layer(
    index: int, layer: FixedLayer, low: np.ndarray, high: np.ndarray, hidden: bool
) -> tuple[RowRange, ...]:
    """Exact ranges of a layer's rows for Python integers as inputs in [low, high].

    Raises:
        InputError: a row that fails.
    """
    if layer.weights.shape != (len(layer.bias), len(low)):
        raise InputError(
            f"layer {index}: weights of shape {layer.weights.shape} do not fit {len(low)} inputs "
            f"and {len(layer.bias)} rows"
        )
    weights, bias = layer.weights.astype(object), layer.bias.astype(object)
    positive, negative = np.maximum(weights, 0), np.minimum(weights, 0)
    bottoms = positive @ low + negative @ high + bias
    tops = positive @ high + negative @ low + bias
    magnitudes = abs(weights) @ np.maximum(-low, high) + abs(bias)
    rows = tuple(RowRange(*ends) for ends in zip(bottoms, tops, magnitudes, strict=True))
    for number, row in enumerate(rows):
        if row.magnitude >= ACCUMULATOR:
            raise InputError(
                f"layer {index}, row {number}: the accumulator may reach "
                f"2^{math.log2(row.magnitude):.2f}, allowed: below 2^63"
            )
        if hidden and row.high >> WORD > LARGEST_HIDDEN:
            raise InputError(
                f"layer {index}, row {number}: the output may reach {row.high >> WORD}, "
                f"allowed: {LARGEST_HIDDEN}"
            )
    return rows


def _prove_output(network: FixedNetwork, rows: tuple[RowRange, ...]) -> None:
    """The clamp makes the output's range; its limits must themselves fit."""
    index = len(network.hidden)
    for number in range(len(rows)):
        limit = max(abs(int(network.command_low[number])), abs(int(network.command_high[number])))
        if limit << network.output_shift >= ACCUMULATOR or limit >= 2**31:
            raise InputError(f"layer {index}, row {number}: its clamp does not fit in 63 bits")
