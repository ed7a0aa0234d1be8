"""The second-order Butterworth low-pass, sample by sample.

With ``w = tan(pi f_c / f_s)``, ``n = 1 / (1 + sqrt(2) w + w^2)`` and ``k = n w^2``::

    feedback   = [2 n (w^2 - 1), n (1 - sqrt(2) w + w^2)]
    forward    = k [1, 2, 1]               the low-pass H(s)
    derivative = 2 f_s k [1, 0, -1]        s H(s): the low-pass of the derivative, 1/s

by the bilinear transform. ``k`` is computed as ``(1 + feedback[0] + feedback[1]) / 4``, so that the
gain at zero frequency is exactly one with rounded coefficients. ``s H(s)`` has the poles of ``H``
and a phase of exactly 90 degrees more at every frequency, so no delay of its own; noise above the
cutoff is not amplified. Offline zero-phase filtering is ``scipy.signal.sosfiltfilt``.
"""

import functools
import operator
from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Rotors, Vec3

Sample = TypeVar("Sample", jax.Array, Vec3, Rotors)
SQRT2 = float(np.sqrt(2.0))


class LowPass(struct.PyTreeNode):
    """Coefficients of the filter at one sample rate; all of it traced."""

    feedback: jax.Array  # (2,)
    forward: jax.Array  # (3,)
    derivative: jax.Array  # (3,) 1/s


def butterworth(sample_rate: Scalar, cutoff: Scalar) -> LowPass:
    """The second-order Butterworth low-pass.

    Args:
        sample_rate: Hz, constant; may be traced.
        cutoff: -3 dB frequency, Hz; may be traced.

    Raises:
        InputError: a cutoff that is not between zero and half the sample rate (where both are
            plain numbers).
    """
    plain = isinstance(sample_rate, (int, float)) and isinstance(cutoff, (int, float))
    if plain and not 0.0 < cutoff < 0.5 * sample_rate:
        raise InputError(
            f"filter cutoff is {cutoff} Hz, allowed: between 0 and half the sample rate "
            f"({sample_rate} Hz)"
        )
    library = np if plain else jnp  # in double precision where the numbers are known now
    w = library.tan(np.pi * cutoff / sample_rate)
    n = 1.0 / (1.0 + SQRT2 * w + w * w)
    feedback = jnp.stack(
        [jnp.asarray(a) for a in (2.0 * n * (w * w - 1.0), n * (1.0 - SQRT2 * w + w * w))]
    )
    k = 0.25 * ((1.0 + feedback[0]) + feedback[1])
    zero = jnp.zeros_like(k)
    return LowPass(
        feedback=feedback,
        forward=jnp.stack([k, 2.0 * k, k]),
        derivative=2.0 * sample_rate * jnp.stack([k, zero, -k]),
    )


def advance(
    feedback: jax.Array, inputs: Sequence[tuple[Sample, jax.Array]], memory: tuple[Sample, Sample]
) -> tuple[Sample, tuple[Sample, Sample]]:
    """One sample, in the transposed direct form II.

    Args:
        feedback: (2,) coefficients.
        inputs: signals that share the poles, each with its forward coefficients (3,).
        memory: two numbers per channel, from the last sample; ``settled`` or zeros at first.

    Returns:
        The sum of the filtered inputs, and the new memory.
    """

    def taps(index: int) -> list[Sample]:
        return [signal * forward[index] for signal, forward in inputs]

    def total(terms: list[Sample]) -> Sample:
        return functools.reduce(operator.add, terms)

    output = total(taps(0) + [memory[0]])
    first = total([memory[1]] + taps(1)) - output * feedback[0]
    return output, (first, total(taps(2)) - output * feedback[1])


def settled(signal: Sample, forward: jax.Array) -> tuple[Sample, Sample]:
    """The memory at which a constant ``signal`` has had the output zero.

    ``forward`` (3,) sums to zero, as ``LowPass.derivative`` does.
    """
    second = signal * forward[2]
    return signal * forward[1] + second, second
