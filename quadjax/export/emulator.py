"""The fixed-point policy in NumPy: the same integers as the C, by int64 arithmetic."""

import numpy as np

from quadjax.export.fixed import (
    LARGEST_INPUT,
    TANH_FRACTION_BITS,
    TANH_LIMIT,
    WORD,
    FixedNetwork,
)
from quadjax.export.squash import VALUE_BITS, tanh_q

DIGEST_START = 2166136261  # FNV-1a over 32-bit words
DIGEST_FACTOR = 16777619


def quantize(
    network: FixedNetwork, observations: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs as integers, and which were clipped and which were NaN.

    Args:
        network: whose box is the declared range.
        observations: (n, inputs) float32; NaN becomes zero, what is outside goes to the edge.

    Returns:
        ``q`` (n, inputs) int32, and two masks (n,) uint32 with bit i for input i.
    """
    given = np.asarray(observations, np.float32)
    nan = np.isnan(given)
    x = np.where(nan, np.float32(0), given).astype(np.float64)
    limit = network.box.ranges
    clipped = np.abs(x) > limit
    held = np.clip(x, -limit, limit)
    q = np.trunc(held * (LARGEST_INPUT / limit)).astype(np.int32)
    bits = np.uint32(1) << np.arange(network.inputs, dtype=np.uint32)
    return q, (clipped * bits).sum(1, dtype=np.uint32), (nan * bits).sum(1, dtype=np.uint32)


def forward_q(network: FixedNetwork, q: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) int32, in units of 2^-fraction_bits, of integer inputs (n, inputs)."""
    return forward_traced(network, q)[0]


def forward_traced(network: FixedNetwork, q: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """As ``forward_q``, and every accumulator of each layer, (n, rows) int64."""
    y = np.clip(np.asarray(q, np.int64), -LARGEST_INPUT, LARGEST_INPUT)
    trace = []
    for layer in network.layers:
        sums = y @ layer.weights.T.astype(np.int64) + layer.bias
        trace.append(sums)
        y = np.maximum(sums >> WORD, 0)
    return output_command(network, trace[-1]), trace


def output_command(network: FixedNetwork, sums: np.ndarray) -> np.ndarray:
    """Output accumulators (n, outputs) as commands, int32."""
    shift = network.output_shift
    low, high = network.command_low, network.command_high
    if network.squash == "clip":
        return (np.clip(sums, low << shift, high << shift) >> shift).astype(np.int32)
    limit = TANH_LIMIT << (TANH_FRACTION_BITS + shift)
    action = tanh_q(np.clip(sums, -limit, limit) >> shift)
    # The middle and half of an odd span would not be integers: doubled until the last shift.
    doubled = ((high + low) << VALUE_BITS) + (high - low) * action + (1 << VALUE_BITS)
    return np.clip(doubled >> (VALUE_BITS + 1), low, high).astype(np.int32)


def forward(network: FixedNetwork, observations: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) int32 of float observations (n, inputs)."""
    return forward_q(network, quantize(network, observations)[0])


def commands(network: FixedNetwork, observations: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) float64, in rpm, or rad/s and m/s^2."""
    return forward(network, observations) / 2.0**network.fraction_bits


def digest_words(words: np.ndarray) -> np.ndarray:
    """Digest (n,) uint32 of words (n, count) uint32, one after another: the C's own."""
    digest = np.full(len(words), DIGEST_START, np.uint32)
    for column in np.asarray(words, np.uint32).T:
        digest = (digest ^ column) * np.uint32(DIGEST_FACTOR)
    return digest


def trace_digest(trace: list[np.ndarray]) -> np.ndarray:
    """Digest (n,) of every accumulator, low word before high word, layer after layer."""
    sums = np.concatenate(trace, axis=1).astype(np.int64)
    words = np.stack([sums & 0xFFFFFFFF, (sums >> 32) & 0xFFFFFFFF], axis=2)
    return digest_words(words.reshape(len(sums), -1).astype(np.uint32))
