"""Observations on which C and NumPy are compared."""

import numpy as np

from quadjax.export.network import FixedNetwork


def check_vectors(
    network: FixedNetwork, count: int, observations: np.ndarray | None, seed: int = 0
) -> np.ndarray:
    """Observations (count, inputs) float32: corners, simulated, uniform, Gaussian.

    A quarter each. Corners are -range, 0 or +range in every input; the simulated ``observations``
    are repeated with noise of one percent; the Gaussian ones have a standard deviation of half the
    range, so that some of them leave the box.
    """
    rng = np.random.default_rng(seed)
    ranges = network.box.ranges
    quarter = count // 4
    shape = (quarter, network.inputs)
    corners = rng.integers(-1, 2, shape) * ranges
    uniform = rng.uniform(-1.0, 1.0, shape) * ranges
    gaussian = rng.standard_normal((count - 3 * quarter, network.inputs)) * 0.5 * ranges
    if observations is not None and len(observations):
        repeated = observations[rng.integers(0, len(observations), quarter)]
        repeated = repeated + 0.01 * ranges * rng.standard_normal(shape)
        repeated[: len(observations)] = observations[:quarter]
    else:
        repeated = rng.standard_normal(shape) * 0.1 * ranges
    return np.concatenate([corners, repeated, uniform, gaussian]).astype(np.float32)


def hostile_vectors(network: FixedNetwork) -> np.ndarray:
    """NaN of several kinds, infinity, huge and subnormal numbers in every position, float32."""
    bits = np.array(
        [
            *(0x7FC00000, 0xFFC00000, 0x7F800001, 0xFFFFFFFF, 0x7FFFFFFF),  # NaN, quiet and not
            *(0x7F800000, 0xFF800000, 0x7F7FFFFF, 0xFF7FFFFF),  # infinite and largest
            *(0x00000001, 0x80000001, 0x007FFFFF, 0x807FFFFF, 0x00800000),  # subnormal, smallest
            *(0x00000000, 0x80000000),
        ],
        np.uint32,
    )
    specials = bits.view(np.float32)
    rng = np.random.default_rng(2)
    base = (0.3 * network.box.ranges * rng.standard_normal(network.inputs)).astype(np.float32)
    vectors = np.tile(base, (len(bits) * network.inputs, 1))
    for position in range(network.inputs):
        rows = slice(position * len(bits), (position + 1) * len(bits))
        vectors.view(np.uint32)[rows, position] = bits
    return np.concatenate([vectors, np.tile(specials[:, None], (1, network.inputs))])
