"""tanh in integers, for policies whose output is squashed by it: a table of cubics.

``|z|`` in Q27 has its segment in the upper bits, 1/32 wide, and its place within the segment in the
lower 22. Each segment is the cubic that has tanh's values and slopes at both ends, its four
coefficients int32 in Q30 of the place in [0, 1).
"""

import functools

import numpy as np

SEGMENT_BITS = 22  # of the place within a segment
SEGMENTS_PER_UNIT = 32
UNITS = 12
VALUE_BITS = 30
# |integer tanh - tanh|: the cubic's h^4 / 384 max|tanh''''|, six roundings of 2^-30, and 1 -
# tanh(12); measured in the tests at less.
SQUASH_ERROR = 1.2e-8 + 6 * 2.0**-VALUE_BITS + 1e-10


@functools.cache
def coefficients() -> np.ndarray:
    """The cubics (segments, 4), int32: constant, linear, quadratic, cubic."""
    step = 1.0 / SEGMENTS_PER_UNIT
    ends = np.arange(UNITS * SEGMENTS_PER_UNIT + 1) * step
    value = np.tanh(ends)
    slope = step * (1.0 - value * value)
    rise = value[1:] - value[:-1]
    cubic = [
        value[:-1],
        slope[:-1],
        3.0 * rise - 2.0 * slope[:-1] - slope[1:],
        -2.0 * rise + slope[:-1] + slope[1:],
    ]
    return np.rint(np.stack(cubic, axis=1) * 2.0**VALUE_BITS).astype(np.int32)


def tanh_q(z: np.ndarray) -> np.ndarray:
    """Hyperbolic tangent of Q27 integers below 12 in magnitude, as Q30 integers (int64)."""
    magnitude = np.minimum(np.abs(z), (UNITS * SEGMENTS_PER_UNIT << SEGMENT_BITS) - 1)
    row = coefficients().astype(np.int64)[magnitude >> SEGMENT_BITS]
    place = magnitude & ((1 << SEGMENT_BITS) - 1)
    value = row[..., 3]
    for power in (2, 1, 0):
        value = row[..., power] + ((value * place) >> SEGMENT_BITS)
    value = np.clip(value, 0, 1 << VALUE_BITS)
    return np.where(z < 0, -value, value)
