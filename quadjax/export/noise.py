"""The noise of a policy that samples its actions on board, with the same integers as the C.

A policy of the paper is a normal distribution around the network's output, whose samples are
clipped to the command range. In units of a command's last bit a sample is::

    clip((sum >> output_shift) + round(n factor / 2**16), low, high)

with the output's accumulator ``sum`` (its first term clipped too if the policy was trained so,
``noise_on: clipped_mean`` of its file) and ``n`` the sum of 12 uniform integers of 16 bits less its
mean. ``n / 2**16`` has a mean of 0 and a variance of 1 (to 2e-10), is within 6, has an excess
kurtosis of -0.1, and its distribution function differs from the normal one by at most 0.0023.

The bits are hashes of a counter (lowbias32 of C. Wellons' hash-prospector, a bijection of 32 bits)
that steps by 2**32 over the golden ratio: any number is a seed, and nothing branches on data. A
step takes 24 of the 2**32 numbers of the sequence, so it repeats after four days at 512 Hz.
"""

import dataclasses

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.emulator import forward_traced
from quadjax.export.integers import digest, round_shift
from quadjax.export.network import FixedNetwork
from quadjax.policy.file import Policy

STEP, FACTORS = 0x9E3779B9, (0x7FEB352D, 0x846CA68B)
HASHES = 6  # of each number: 12 halves of 16 bits
NOISE_BITS = 16  # of a standard deviation
LARGEST = 6 * 0xFFFF  # |n|
LARGEST_FACTOR = 2**31 - 1
LARGEST_LOG_STD = 100.0  # beyond which no factor fits either, and whose exponential is finite
TESTED = 64  # steps of the self-test


@dataclasses.dataclass(frozen=True)
class NoiseTables:
    """The noise of a policy: what the words contain."""

    factors: tuple[int, ...]  # standard deviation of each command, in its last bits
    on_clamped: bool  # the noise is added to the clamped mean, as in the training of SHAC
    digest: int  # of the noise of the first steps from counter 0

    @classmethod
    def of(cls, factors: tuple[int, ...], on_clamped: bool) -> "NoiseTables":
        """Noise with the digest that its factors give.

        Raises:
            InputError: a standard deviation that does not fit in its word.
        """
        for number, factor in enumerate(factors):
            if not 0 <= factor <= LARGEST_FACTOR:
                raise InputError(
                    f"log_std {number}: a standard deviation of {factor:g} units of the command, "
                    f"allowed: 0 to {LARGEST_FACTOR}"
                )
        steps = noise(factors, 0, TESTED)
        return cls(factors, on_clamped, int(digest(steps.reshape(1, -1))[0]))


def make_noise(policy: Policy, network: FixedNetwork) -> NoiseTables:
    """The noise of a policy's training: ``exp(log_std)`` of half its command range.

    No sum overflows: an accumulator of less than 2**63, shifted by at least one, is below 2**62,
    and the noise below 2**50.

    Raises:
        InputError: a standard deviation that does not fit.
    """
    half = 0.5 * (policy.command_high - policy.command_low)
    deviation = np.exp(np.minimum(policy.log_std.astype(np.float64), LARGEST_LOG_STD))
    factors = tuple(round(x) for x in deviation * half * 2.0**network.fraction_bits)
    return NoiseTables.of(factors, policy.noise_on == "clipped_mean")


def noise(factors: tuple[int, ...], counter: int, steps: int) -> np.ndarray:
    """Noise (steps, commands) int64 from a counter of the generator on, as ``noise_of`` in C."""
    count = steps * len(factors) * HASHES
    at = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(STEP) + np.uint64(counter % 2**32)
    x = at.astype(np.uint32)
    for shift, factor in zip((16, 15), FACTORS, strict=True):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    x = (x ^ (x >> np.uint32(16))).reshape(steps, len(factors), HASHES).astype(np.int64)
    normal = ((x & 0xFFFF) + (x >> 16)).sum(axis=2) - LARGEST
    return round_shift(normal * np.array(factors, np.int64), NOISE_BITS)


def advanced(counter: int, steps: int, commands: int) -> int:
    """The counter after a number of steps."""
    return (counter + steps * commands * HASHES * STEP) % 2**32


def sample(network: FixedNetwork, tables: NoiseTables, q: np.ndarray, counter: int) -> np.ndarray:
    """Sampled commands (n, commands) int32 of integer inputs (n, inputs), one step per row."""
    sums = forward_traced(network, q)[1][-1] >> network.output_shift
    low, high = network.command_low, network.command_high
    mean = np.clip(sums, low, high) if tables.on_clamped else sums
    return np.clip(mean + noise(tables.factors, counter, len(q)), low, high).astype(np.int32)
