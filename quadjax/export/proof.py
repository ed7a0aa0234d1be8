"""Proof that no input can overflow: exact integer intervals.

Intervals are computed in Python's own integers from the box of inputs on. For every row
``|bias| + sum_j |w_ij| max|x_j| < 2**63``, so any order of summation is safe, and for every hidden
row ``0 <= y <= 2**30 - 1``. That holds for every input, not for a sample.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.integers import ONE, WORD
from quadjax.export.network import LARGEST_HIDDEN, FixedLayer, FixedNetwork, exact, output_layer
from quadjax.policy.file import Policy

ACCUMULATOR = 2**63 - 2**30  # with room for a rounding half, as in the C
SLACK = 2.0**-36  # more than the rounding of float64 in any sum here


class Ranges(NamedTuple):
    """Exact ranges of a layer's rows for every input in the box, (rows,) Python integers."""

    low: np.ndarray  # of the accumulator
    high: np.ndarray
    magnitude: np.ndarray  # |bias| + sum |w| max|x|, which bounds every partial sum


@dataclasses.dataclass(frozen=True)
class Proof:
    """Proven properties of a network."""

    layers: tuple[Ranges, ...]
    error_bound: np.ndarray  # (outputs,) |command - real arithmetic|, in the command's unit

    @property
    def accumulator_bits(self) -> list[float]:
        """Bits of the largest accumulator of each layer, out of 63."""
        return [math.log2(max(*layer.magnitude, 1)) for layer in self.layers]


def prove(network: FixedNetwork, policy: Policy) -> Proof:
    """Prove the ranges of a network and bound its error against the real-valued policy.

    Raises:
        InputError: see ``prove_layers``; or a clamp of a command that does not fit.
    """
    layers = prove_layers(network.layers, network.inputs)
    for number, ends in enumerate(zip(network.command_low, network.command_high, strict=True)):
        limit = max(abs(int(end)) for end in ends)
        if limit << network.output_shift >= ACCUMULATOR or limit >= 2**31:
            raise InputError(
                f"layer {len(network.layers) - 1}, row {number}: its clamp does not fit in 63 bits"
            )
    return Proof(layers, error_bound(network, policy))


def prove_layers(layers: Sequence[FixedLayer], inputs: int) -> tuple[Ranges, ...]:
    """Exact ranges of the rows of ReLU layers and a linear one, for inputs in +-2^30.

    Raises:
        InputError: a row whose accumulator may overflow or whose output may leave its range, or
            a table of the wrong shape, by layer and row.
    """
    high = np.array([ONE] * inputs, object)
    low, proven = -high, list[Ranges]()
    for index, layer in enumerate(layers):
        if layer.weights.shape != (len(layer.bias), len(low)):
            raise InputError(
                f"layer {index}: weights of shape {layer.weights.shape} do not fit {len(low)} "
                f"inputs and {len(layer.bias)} rows"
            )
        weights, bias = layer.weights.astype(object), layer.bias.astype(object)
        positive, negative = np.maximum(weights, 0), np.minimum(weights, 0)
        bottoms = positive @ low + negative @ high + bias
        tops = positive @ high + negative @ low + bias
        sums = abs(weights) @ np.maximum(-low, high) + abs(bias)
        low, high = (np.maximum(ends >> WORD, 0) for ends in (bottoms, tops))
        for row, (total, output) in enumerate(zip(sums, high, strict=True)):
            if total >= ACCUMULATOR:
                raise InputError(
                    f"layer {index}, row {row}: the accumulator may reach "
                    f"2^{math.log2(total):.2f}, allowed: below 2^63"
                )
            if index + 1 < len(layers) and output > LARGEST_HIDDEN:
                raise InputError(
                    f"layer {index}, row {row}: the output may reach {output}, "
                    f"allowed: {LARGEST_HIDDEN}"
                )
        proven.append(Ranges(bottoms, tops, sums))
    return tuple(proven)


def error_bound(network: FixedNetwork, policy: Policy) -> np.ndarray:
    """Bound of |fixed point - real arithmetic| of each command, for every input in the box.

    The integer weights of a layer represent ``V = W + D`` with the real weights ``W``. With the
    real activations ``y`` the error of the integer ones is at most ``|V| e + |D| |y| + |c| + h``:
    the error of the inputs, that of weights and bias, and the rounding of the result, at most half
    a unit. A ReLU and a clamp do not make it larger.

    Returns:
        (outputs,) in the command's unit.
    """
    real = [(exact(kernel).T, exact(bias)) for kernel, bias in policy.layers[:-1]]
    scale = error = network.box.ranges / ONE  # of the inputs: truncated
    low, high = -network.box.ranges, network.box.ranges
    layers = zip([*real, output_layer(policy)], network.layers, strict=True)
    for (weights, bias), layer in layers:
        is_output = layer is network.layers[-1]
        shift = network.output_shift if is_output else WORD
        unit = layer.scale * 2.0**-shift  # real value of one unit of the accumulator
        fixed = layer.weights * unit[:, None] / scale
        offset = layer.bias - 2.0 ** (shift - 1)
        active = np.any(layer.weights, axis=1) | (offset != 0) | is_output
        largest = np.maximum(np.abs(low), np.abs(high))
        local = np.abs(fixed - weights) @ largest + np.abs(offset * unit - bias)
        error = (np.abs(fixed) @ error + local + 0.5 * layer.scale) * active
        positive, negative = np.maximum(weights, 0.0), np.minimum(weights, 0.0)
        ends = (positive @ low + negative @ high + bias, positive @ high + negative @ low + bias)
        low, high = (np.maximum(end, 0.0) for end in ends)
        scale = layer.scale
    return (1.0 + SLACK) * (error + 2.0**-network.fraction_bits)
