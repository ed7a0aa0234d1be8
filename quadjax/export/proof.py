"""Proof that no input can overflow: exact integer intervals.

Intervals are computed in Python's own integers from the box of inputs on. For every row
``|bias| + sum_j |w_ij| max|x_j| < 2**63``, so any order of summation is safe, and for every hidden
row ``0 <= y <= 2**30 - 1``. That holds for every input, not for a sample.
"""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import LARGEST_HIDDEN, FixedLayer, FixedNetwork
from quadjax.export.integers import ONE, WORD
from quadjax.policy.file import Policy

SLACK = 2.0**-36  # more than the rounding of float64 in any sum here
ACCUMULATOR = 2**63 - 2**30  # with room for a rounding half, as in the C


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


def error_bound(network: FixedNetwork, policy: Policy) -> np.ndarray:
    """Bound of |fixed point - real arithmetic| of each command, for every input in the box.

    The integer weights of a layer represent ``V = W + D`` with the real weights ``W``. With the
    real activations ``y`` the error of the integer ones is at most ``|V| e + |D| |y| + |c| + h``:
    the error of the inputs, that of weights and bias, and the rounding of the result, at most half
    a unit. A ReLU and a clamp do not make it larger.

    Returns:
        (outputs,) in the command's unit.
    """
    exact = [tuple(np.asarray(x, np.float32).astype(np.float64) for x in p) for p in policy.layers]
    half = 0.5 * (policy.command_high - policy.command_low)
    middle = 0.5 * (policy.command_high + policy.command_low)
    exact[-1] = (exact[-1][0] * half, exact[-1][1] * half + middle)
    scale = error = network.box.ranges / ONE  # of the inputs: truncated
    low, high = -network.box.ranges, network.box.ranges
    for (kernel, bias), layer in zip(exact, network.layers, strict=True):
        shift = network.output_shift if layer is network.output else WORD
        unit = layer.scale * 2.0**-shift  # real value of one unit of the accumulator
        fixed = layer.weights * unit[:, None] / scale
        offset = layer.bias - 2.0 ** (shift - 1)
        active = np.any(layer.weights, axis=1) | (offset != 0) | (layer is network.output)
        largest = np.maximum(np.abs(low), np.abs(high))
        local = np.abs(fixed - kernel.T) @ largest + np.abs(offset * unit - bias)
        error = (np.abs(fixed) @ error + local + 0.5 * layer.scale) * active
        positive, negative = np.maximum(kernel.T, 0.0), np.minimum(kernel.T, 0.0)
        ends = (positive @ low + negative @ high + bias, positive @ high + negative @ low + bias)
        low, high = (np.maximum(end, 0.0) for end in ends)
        scale = layer.scale
    return (1.0 + SLACK) * (error + 2.0**-network.fraction_bits)


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
