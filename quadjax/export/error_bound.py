"""A bound of the error of a fixed-point network against real arithmetic, for every input.

Layer ``l`` has real weights ``W``, and integers that represent ``V = W + D``. With real activations
``y`` and errors ``e`` of the integer ones, ``e_l = S (V e_(l-1) + r_l)`` with the local error
``r_l = D y_(l-1) + c + h``: rounded weights, rounded bias and the rounding of the result, which is
at most half a unit. ``S`` is diagonal, with the slopes in [0, 1] of the ReLU. So the error of the
commands is ``sum_l M_l r_l``, where ``M_l`` is a product of the ``V`` and ``S`` after layer ``l``.

``r_l`` is bounded in two ways: each element by linear bounds of the network (``LinearBounds``), and
its 2-norm by ``|D u z + c| <= |c| + |D u|_2 sqrt(n)`` with ``y = m + u z``, ``|z_i| <= 1``. The
rows of ``M_l`` are bounded likewise: each element by an interval from the output backwards, and the
2-norm by spectral norms. Each product ``M_l r_l`` takes the smaller of both bounds.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import ONE, WORD
from quadjax.policy.file import Policy

SLACK = 2.0**-40  # of a sum of magnitudes: more than float64 can lose in any sum here
LONG_SLACK = 2.0**-36  # of sums through all layers
SQUARINGS = 6

Interval = tuple[np.ndarray, np.ndarray]  # lowest and highest


@dataclasses.dataclass(frozen=True)
class _Layer:
    """A layer in real numbers, and the rounding errors of its integers."""

    weights: np.ndarray  # W (rows, columns)
    bias: np.ndarray  # (rows,)
    fixed: np.ndarray  # V (rows, columns)
    difference: np.ndarray  # D (rows, columns)
    offset: np.ndarray  # c (rows,)
    half: np.ndarray  # h (rows,), half a unit of the result
    active: (
        np.ndarray
    )  # (rows,) False for a hidden neuron that is zero for every input; D = 0 there


def error_bound(network: FixedNetwork, policy: Policy) -> np.ndarray:
    """Bound of |fixed point - real arithmetic| of each command, for every input in the box.

    Returns:
        (outputs,) in the command's unit.
    """
    layers, unit = _layers(network, policy), network.box.ranges / ONE
    bounds = LinearBounds([(layer.weights, layer.bias) for layer in layers], network.box.ranges)
    low = high = np.eye(network.outputs)
    norm, total = np.ones(network.outputs), np.zeros(network.outputs)
    for index, layer in reversed(list(enumerate(layers))):
        if index < len(layers) - 1:  # a ReLU
            low, high = np.minimum(low, 0.0) * layer.active, np.maximum(high, 0.0) * layer.active
        error, length = _local_error(layer, bounds, index)
        total += np.minimum(_largest((low, high), error), norm * length)
        low, high = _product((low, high), layer.fixed)
        rows = np.linalg.norm(_magnitude((low, high)), axis=1)
        norm = np.minimum(norm * spectral_norm(layer.fixed), rows)
    total += np.minimum(_magnitude((low, high)) @ unit, norm * np.linalg.norm(unit))  # truncation
    return (1.0 + LONG_SLACK) * (total + 2.0**-network.fraction_bits)


def _layers(network: FixedNetwork, policy: Policy) -> list[_Layer]:
    """The real layers, the last one to commands, and the rounding errors of their integers."""
    exact = [tuple(np.asarray(x, np.float32).astype(np.float64) for x in p) for p in policy.layers]
    half = 0.5 * (policy.command_high - policy.command_low)
    kernel, bias = exact[-1]
    middle = 0.5 * (policy.command_high + policy.command_low)
    exact[-1] = (kernel * half, bias * half + middle)
    layers, scale = [], network.box.ranges / ONE
    for (kernel, bias), layer in zip(exact, network.layers, strict=True):
        shift = network.output_shift if layer is network.output else WORD
        unit = layer.scale * 2.0**-shift  # real value of one unit of the accumulator
        fixed = layer.weights * unit[:, None] / scale
        offset = layer.bias - 2.0 ** (shift - 1)
        active = np.any(layer.weights, axis=1) | (offset != 0) | (layer is network.output)
        layers.append(
            _Layer(
                weights=kernel.T,
                bias=bias,
                fixed=fixed,
                difference=(fixed - kernel.T) * active[:, None],
                offset=(offset * unit - bias) * active,
                half=0.5 * layer.scale * active,
                active=active,
            )
        )
        scale = layer.scale
    return layers


class LinearBounds:
    """Bounds of a ReLU network over a box of inputs, by linear functions of the inputs.

    A ReLU of ``a`` in [l, u] lies below the line ``u (a - l) / (u - l)`` and above ``a`` or 0,
    whichever is closer (Zhang et al., "Efficient neural network robustness certification with
    general activation functions", 2018).
    """

    def __init__(self, layers: Sequence[tuple[np.ndarray, np.ndarray]], box: np.ndarray) -> None:
        """Bound every hidden layer of ``layers`` (weights, bias) over inputs in +-``box``."""
        self._layers, self._box = layers, box
        self._sums: list[Interval] = []  # of each hidden layer before its ReLU
        self._sizes = [box]  # of sums of magnitudes
        for index, (weights, bias) in enumerate(layers[:-1]):
            self._sums.append(self.of(weights, bias, index))
            self._sizes.append(np.abs(weights) @ self._sizes[-1] + np.abs(bias))

    def inputs(self, index: int) -> Interval:
        """The range of the inputs of a layer."""
        if index == 0:
            return -self._box, self._box
        low, high = self._sums[index - 1]
        return np.maximum(low, 0.0), np.maximum(high, 0.0)

    def of(self, weights: np.ndarray, bias: np.ndarray, index: int) -> Interval:
        """Interval (rows,) of ``weights x + bias`` of the inputs ``x`` of layer ``index``."""
        low, high = self.inputs(index)
        positive, negative = np.maximum(weights, 0.0), np.minimum(weights, 0.0)
        slack = LONG_SLACK * (np.abs(weights) @ self._sizes[index] + np.abs(bias))
        below = positive @ low + negative @ high + bias
        above = positive @ high + negative @ low + bias
        if index > 0:
            above = np.minimum(above, self._highest(weights, bias, index))
            below = np.maximum(below, -self._highest(-weights, -bias, index))
        return below - slack, above + slack

    def _highest(self, weights: np.ndarray, bias: np.ndarray, index: int) -> np.ndarray:
        for (below, above), (inner, offset) in reversed(
            list(zip(self._sums[:index], self._layers[:index], strict=True))
        ):
            low, high = np.minimum(below, 0.0), np.maximum(above, 0.0)
            slope = high / np.maximum(high - low, np.finfo(float).tiny)  # 0: never active
            positive = np.maximum(weights, 0.0)
            bias = bias - positive @ (low * slope)
            weights = positive * slope + np.minimum(weights, 0.0) * (high > -low)
            bias = bias + weights @ offset
            weights = weights @ inner
        return bias + np.abs(weights) @ self._box


def _local_error(layer: _Layer, bounds: LinearBounds, index: int) -> tuple[Interval, float]:
    """The local error of a layer: the interval (rows,) of each element, and the 2-norm."""
    low, high = bounds.inputs(index)
    largest = np.maximum(np.abs(low), np.abs(high))
    slack = SLACK * (np.abs(layer.weights) @ largest + np.abs(layer.bias)) + layer.half
    below, above = bounds.of(layer.difference, layer.offset, index)
    interval = below - slack, above + slack
    center = layer.difference @ (0.5 * (low + high)) + layer.offset
    spread = spectral_norm(layer.difference * (0.5 * (high - low))) * np.sqrt(len(low))
    length = np.linalg.norm(center) + spread + np.linalg.norm(slack)
    return interval, float(min(length, np.linalg.norm(_magnitude(interval))))


def spectral_norm(matrix: np.ndarray) -> float:
    """An upper bound of a matrix's spectral norm: ``|A|_2^(2k) <= |(A' A)^k|_F``, k = 2^6."""
    tall = matrix.shape[0] > matrix.shape[1]
    power = matrix.T @ matrix if tall else matrix @ matrix.T
    logarithm = 0.0
    for _ in range(SQUARINGS):
        norm = np.linalg.norm(power)
        if norm == 0.0:
            return 0.0
        power = (power / norm) @ (power / norm)
        logarithm = 2.0 * (logarithm + np.log(norm))
    logarithm += np.log(np.linalg.norm(power))
    return (1.0 + LONG_SLACK) * float(np.exp(logarithm / 2.0 ** (SQUARINGS + 1)))


def _product(factor: Interval, matrix: np.ndarray) -> Interval:
    """Interval of a matrix product (n, columns) of an interval (n, rows) and a known matrix."""
    low, high = factor
    positive, negative = np.maximum(matrix, 0.0), np.minimum(matrix, 0.0)
    slack = SLACK * (_magnitude(factor) @ np.abs(matrix))
    return low @ positive + high @ negative - slack, high @ positive + low @ negative + slack


def _magnitude(interval: Interval) -> np.ndarray:
    return np.maximum(np.abs(interval[0]), np.abs(interval[1]))


def _largest(factor: Interval, vector: Interval) -> np.ndarray:
    """Largest magnitude (n,) of the product of an interval (n, rows) and an interval (rows,)."""
    ends = [end * side for end in factor for side in vector]
    return np.maximum(np.max(ends, axis=0).sum(axis=1), -np.min(ends, axis=0).sum(axis=1))
