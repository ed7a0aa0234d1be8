"""The fixed-point policy in NumPy or JAX: the integers of the C, bit for bit."""

from types import ModuleType

import numpy as np

from quadjax.export import integers
from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import ONE, Array, dense, hidden_output


def quantize(
    network: FixedNetwork, observations: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs as integers, and which were clipped and which were NaN.

    Args:
        network: whose box is the declared range.
        observations: (n, inputs) float32.

    Returns:
        ``q`` (n, inputs) int32, and two masks (n,) uint32 with bit i for input i.
    """
    exponents = network.box.exponents
    q = integers.quantize(observations, exponents).astype(np.int32)
    return (q, *integers.status_masks(observations, exponents))


def forward_q(network: FixedNetwork, q: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) int32, in units of 2^-fraction_bits, of integer inputs (n, inputs)."""
    return forward_traced(network, q)[0]


def forward_traced(
    network: FixedNetwork, q: Array, xp: ModuleType = np
) -> tuple[Array, list[Array]]:
    """As ``forward_q``, and every accumulator of each layer, (.., rows) int64."""
    y = xp.clip(xp.asarray(q, xp.int64), -ONE, ONE)
    trace = []
    for layer in network.layers:
        trace.append(dense(y, layer.weights, layer.bias, xp))
        y = hidden_output(trace[-1], xp)
    shift = network.output_shift
    low, high = network.command_low << shift, network.command_high << shift
    return (xp.clip(trace[-1], low, high) >> shift).astype(xp.int32), trace


def forward(network: FixedNetwork, observations: Array, xp: ModuleType = np) -> Array:
    """Commands (.., outputs) int32 of float observations (.., inputs)."""
    q = integers.quantize(observations, network.box.exponents, xp)
    return forward_traced(network, q, xp)[0]


def commands(network: FixedNetwork, observations: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) float64, in rpm, or rad/s and m/s^2."""
    return forward(network, observations) / 2.0**network.fraction_bits


def trace_digest(trace: list[np.ndarray]) -> np.ndarray:
    """Digest (n,) of every accumulator, low word before high word, layer after layer."""
    return integers.digest(integers.words_of(np.concatenate(trace, axis=1)))
