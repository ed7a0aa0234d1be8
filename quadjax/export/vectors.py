"""Inputs that a fixed-point policy is checked with: corners, flown, uniform and Gaussian."""

import dataclasses

import numpy as np

from quadjax.export.fixed import LARGEST_INPUT, FixedNetwork

CORNERS, FLOWN, RANDOM = 8, 16, 8


@dataclasses.dataclass(frozen=True)
class SelfTest:
    """The inferences that the emitted self-test repeats."""

    inputs: np.ndarray  # (n, inputs) int32
    kinds: tuple[str, ...]  # what each is


def self_test_inputs(network: FixedNetwork, flown: np.ndarray | None) -> SelfTest:
    """Corners of the box, flown observations evenly spread over ``flown``, and random ones."""
    from quadjax.export.emulator import quantize

    rng = np.random.default_rng(0)
    signs = rng.choice([-1, 1], (CORNERS, network.inputs))
    signs[0], signs[1] = 1, -1
    corners = signs * LARGEST_INPUT
    parts, kinds = [corners], ["corner"] * CORNERS
    random = RANDOM
    if flown is not None and len(flown):
        pick = np.linspace(0, len(flown) - 1, FLOWN).astype(int)
        parts.append(quantize(network, flown[pick])[0])
        kinds += ["flown"] * FLOWN
    else:
        random += FLOWN
    parts.append(rng.integers(-LARGEST_INPUT, LARGEST_INPUT + 1, (random, network.inputs)))
    kinds += ["random"] * random
    return SelfTest(np.concatenate(parts).astype(np.int32), tuple(kinds))


def check_vectors(
    network: FixedNetwork, count: int, flown: np.ndarray | None, seed: int = 0
) -> np.ndarray:
    """Observations (count, inputs) float32: a quarter each of corners, flown, uniform, Gaussian.

    Corners are -range, 0 or +range in every input; flown observations are used again and again
    with noise of one per cent; the Gaussian ones have a standard deviation of half the range, so
    that some of them leave the box.
    """
    rng = np.random.default_rng(seed)
    ranges = network.box.ranges
    quarter = count // 4
    shape = (quarter, network.inputs)
    corners = rng.integers(-1, 2, shape) * ranges
    uniform = rng.uniform(-1.0, 1.0, shape) * ranges
    gaussian = rng.standard_normal((count - 3 * quarter, network.inputs)) * 0.5 * ranges
    if flown is not None and len(flown):
        repeated = flown[rng.integers(0, len(flown), quarter)]
        repeated = repeated + 0.01 * ranges * rng.standard_normal(shape)
        repeated[: len(flown)] = flown[:quarter]
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
