"""A bound of the error of a fixed-point network against real arithmetic, for every input.

A layer of integers differs from the real one by a local error ``r`` (of its weights, its bias and
its rounding) before its ReLU, and a ReLU multiplies a difference by a factor in [0, 1]. So the
error of a command is ``sum_l M_l r_l``, where ``M_l`` is a product of the weights behind layer
``l`` and of such factors. Both are bounded by intervals: ``r_l`` from the signs of the known
rounding errors and the range of the layer's inputs, ``M_l`` from the output backwards.
"""

import numpy as np

from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import ONE, WORD
from quadjax.policy.file import Policy

SLACK = 2.0**-40  # of a sum of magnitudes: more than float64 can lose in any sum here

Interval = tuple[np.ndarray, np.ndarray]  # lowest and highest


def error_bound(network: FixedNetwork, policy: Policy, outputs: list[Interval]) -> np.ndarray:
    """Bound of |fixed point - real arithmetic| of each command, for every input in the box.

    Args:
        network: the integers.
        policy: the real network.
        outputs: interval of the integer outputs of each hidden layer.

    Returns:
        (outputs,) in the command's unit.
    """
    layers = _real_layers(network, policy)
    inputs = [(np.full(network.inputs, -float(ONE)), np.full(network.inputs, float(ONE))), *outputs]
    scales = [network.box.ranges / ONE, *(layer.scale for layer in network.hidden)]
    low = high = np.eye(network.outputs)
    total = np.zeros(network.outputs)
    for index in reversed(range(len(layers))):
        weights, bias = layers[index]
        error = _local_error(network, index, weights, bias, scales[index], inputs[index])
        total += _largest((low, high), error)
        low, high = _product((low, high), weights)
        if index > 0:  # a ReLU; neurons without weights are inactive in reals too
            active = np.any(network.hidden[index - 1].weights, axis=1)
            low, high = np.minimum(low, 0.0) * active, np.maximum(high, 0.0) * active
    total += np.maximum(np.abs(low), np.abs(high)) @ scales[0]  # truncation of the inputs
    return (1.0 + SLACK) * (total + 2.0**-network.fraction_bits)


def _real_layers(network: FixedNetwork, policy: Policy) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights (rows, columns) and bias (rows,) of the real network, the last one to commands."""
    exact = [tuple(np.asarray(x, np.float32).astype(np.float64) for x in p) for p in policy.layers]
    layers = [(kernel.T, bias) for kernel, bias in exact]
    half = 0.5 * (policy.command_high - policy.command_low)
    middle = 0.5 * (policy.command_high + policy.command_low)
    weights, bias = layers[-1]
    return [*layers[:-1], (half[:, None] * weights, half * bias + middle)]


def _local_error(
    network: FixedNetwork,
    index: int,
    weights: np.ndarray,
    bias: np.ndarray,
    scale: np.ndarray,
    inputs: Interval,
) -> Interval:
    """Interval (rows,) of a layer's integer result minus the real one, of equal inputs.

    Args:
        network: the integers.
        index: of the layer.
        weights: real ones, (rows, columns).
        bias: (rows,)
        scale: (columns,) real value of one unit of each input.
        inputs: interval of the integer inputs.
    """
    layer = network.layers[index]
    shift = WORD if index < len(network.hidden) else network.output_shift
    unit = layer.scale * 2.0**-shift  # real value of one unit of the accumulator
    difference = layer.weights * unit[:, None] - weights * scale
    offset = (layer.bias - 2.0 ** (shift - 1)) * unit - bias
    positive, negative = np.maximum(difference, 0.0), np.minimum(difference, 0.0)
    largest = np.maximum(np.abs(inputs[0]), np.abs(inputs[1]))
    slack = SLACK * (np.abs(weights * scale) @ largest + np.abs(bias)) + 0.5 * layer.scale
    low = positive @ inputs[0] + negative @ inputs[1] + offset - slack
    return low, positive @ inputs[1] + negative @ inputs[0] + offset + slack


def _product(factor: Interval, matrix: np.ndarray) -> Interval:
    """Interval of a matrix product (n, columns) of an interval (n, rows) and a known matrix."""
    low, high = factor
    positive, negative = np.maximum(matrix, 0.0), np.minimum(matrix, 0.0)
    slack = SLACK * (np.maximum(np.abs(low), np.abs(high)) @ np.abs(matrix))
    return low @ positive + high @ negative - slack, high @ positive + low @ negative + slack


def _largest(factor: Interval, vector: Interval) -> np.ndarray:
    """Largest magnitude (n,) of the product of an interval (n, rows) and an interval (rows,)."""
    ends = [end * side for end in factor for side in vector]
    return np.maximum(np.max(ends, axis=0).sum(axis=1), -np.min(ends, axis=0).sum(axis=1))
