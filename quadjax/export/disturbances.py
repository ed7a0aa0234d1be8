"""The disturbance estimator in fixed point: model and filter as integers.

The method is that of ``quadjax.vehicle.estimator``. Measurements become integers of 2^-30 of their
ranges; products of two of them (monomials) are kept in Q30; the model is a sum of monomials times
constants, in fine units of 2^-46 of the channel's range; and the filter keeps its memory in those
fine units. With ``K / 2^32`` the low-pass gain, ``K = 2^30 + a1 + a2`` exactly (``a`` in Q30), so
the gain at rest is one without rounding::

    y  = K (x + d) + s1        d = 2 f_s times what is differentiated
    s1 = s2 + 2 K x - a1 y
    s2 = K (x - d) - a2 y
"""

import dataclasses
import math

import jax
import numpy as np
from scipy.signal import butter, lfilter

from quadjax.core import mlp
from quadjax.core.errors import InputError
from quadjax.export.integers import INPUT_BITS, ONE, SPLIT, Rescale
from quadjax.export.network import FixedLayer, convert_hidden, largest_power
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

MODEL_BITS, DIFFERENCE_BITS = 14, 10  # of a monomial's constant beyond the fine unit's
FINE_BITS = 46  # a channel's range is 2^46 fine units
Q30 = INPUT_BITS
SAMPLE_RATE, CUTOFF = 512.0, 8.0  # Hz, if none are given
SAMPLE_RATES = (1.0, 1e5)  # Hz
LOW_PASS_BITS = 32  # of the gain
ROOM = 62  # bits of every sum and product
RESIDUAL_LIMIT = 1 << (FINE_BITS - 1)  # its output is held to half a channel's range
GYRO_EXPONENT, FORCE_EXPONENT, VELOCITY_EXPONENT = 5, 7, 5  # +-32 rad/s, 128 m/s^2, 32 m/s
MONOMIALS = (
    *("p", "q", "r", "a_x", "a_y", "a_z", "v_x", "v_y"),
    *("qr", "rp", "pq", "roll_squares", "pitch_squares", "sum_squares", "imbalance"),
    *("v_x_sum", "v_y_sum", "v_z_sum", "speed_squares"),
)
CHANNELS = ("moment_x", "moment_y", "moment_z", "force_x", "force_y", "force_z")


@dataclasses.dataclass(frozen=True)
class FixedResidual:
    """A residual as integers: networks of ReLU layers, and a linear output in fine units."""

    rpm: Rescale  # rpm to the networks' input
    thrust: tuple[FixedLayer, ...]  # its output is added to the body-z force
    moment: tuple[FixedLayer, ...]
    shifts: tuple[int, ...]  # from the accumulators of the thrust and the moment to fine units


@dataclasses.dataclass(frozen=True)
class EstimatorTables:
    """Integers of the estimator."""

    period_ns: int  # of a sample
    exponents: tuple[int, ...]  # gyro 3, specific force 3, rpm 4, body velocity 3
    channel_exponents: tuple[int, ...]  # of the six channels
    # (9, monomials) int64: of the channels, what is unexplained but for the residual; then, of the
    # moment, what is differentiated
    model: np.ndarray
    a1: int  # Q30
    a2: int  # Q30
    gain: int  # K, Q32
    residual: FixedResidual | None


def monomial_units(exponents: tuple[int, ...]) -> np.ndarray:
    """The real value of one unit of each monomial."""
    g, a, w, v = exponents[0], exponents[3], exponents[6], exponents[10]
    powers = [g] * 3 + [a] * 3 + [v] * 2 + [2 * g] * 3 + [2 * w] * 3 + [w] + [v + w] * 3 + [2 * v]
    return np.ldexp(1.0, np.array(powers) - Q30)


def monomial_bounds() -> np.ndarray:
    """The largest magnitude of each monomial, as an integer; rounding adds at most one."""
    ones = [1] * 11 + [2, 2, 4, 4, 4, 4, 4, 2]
    return np.array(ones, np.int64) * ONE + 2


def make_estimator(
    constants: MotorConstants,
    residual: Residual | None,
    sample_rate: float = SAMPLE_RATE,
    cutoff: float = CUTOFF,
) -> EstimatorTables:
    """The integers of the estimator of one vehicle.

    Raises:
        InputError: a sample rate outside 1 Hz to 100 kHz; a cut-off that is not between a
            thousandth and a quarter of it; constants that leave no room for the proof.
    """
    check_cutoff(sample_rate, cutoff)
    speed = speed_exponent(float(constants.rpm_max))
    exponents = tuple(
        np.repeat([GYRO_EXPONENT, FORCE_EXPONENT, speed, VELOCITY_EXPONENT], [3, 3, 4, 3]).tolist()
    )
    a1, a2 = _feedback(sample_rate, cutoff)
    units = monomial_units(exponents)
    model, differentiated = _model(constants), _differentiated(constants) * 2.0 * sample_rate
    largest, (straight, derivative) = units * monomial_bounds(), filter_gains(sample_rate, cutoff)
    bounds = np.abs(model) @ largest
    outputs = straight * bounds
    outputs[:3] += derivative * (np.abs(differentiated) @ largest)
    if residual is not None:
        # What the residual adds is held to half the range: room for it before and after the filter.
        bounds, outputs = 2.0 * bounds, outputs / (1.0 - 0.5 * straight)
    channels = tuple(math.ceil(math.log2(1.01 * x)) for x in np.maximum(bounds, outputs))
    fine = np.ldexp(1.0, np.array(channels) - FINE_BITS)[:, None]
    rows = [model * units / fine * 2.0**MODEL_BITS]
    rows.append(differentiated * units / fine[:3] * 2.0**DIFFERENCE_BITS)
    tables = EstimatorTables(
        period_ns=round(1e9 / sample_rate),
        exponents=exponents,
        channel_exponents=channels,
        model=np.rint(np.concatenate(rows)).astype(np.int64),
        a1=a1,
        a2=a2,
        gain=(1 << Q30) + a1 + a2,
        residual=None if residual is None else _residual(residual, exponents, channels),
    )
    prove_estimator(tables, straight, derivative)
    prove_terms(tables)
    return tables


def speed_exponent(rpm_max: float) -> int:
    """The exponent of the range of measured speeds, for a highest command in rpm."""
    return math.ceil(math.log2(1.25 * rpm_max))


def check_cutoff(sample_rate: float, cutoff: float) -> None:
    """Check the estimator's numbers, Hz.

    Raises:
        InputError: a sample rate or a cut-off that is not allowed.
    """
    low, high = SAMPLE_RATES
    if not low <= sample_rate <= high:
        raise InputError(
            f"estimator sample rate {sample_rate:g} Hz, allowed: {low:g} to {high:g} Hz"
        )
    if not 0.001 * sample_rate <= cutoff <= 0.25 * sample_rate:
        raise InputError(
            f"estimator cut-off {cutoff:g} Hz, allowed: {0.001 * sample_rate:g} to "
            f"{0.25 * sample_rate:g} Hz at a sample rate of {sample_rate:g} Hz"
        )


def _sums(tables: EstimatorTables) -> list[tuple[int, int]]:
    """Of each channel: bounds of the sum of its model and of what is differentiated."""
    sums = np.abs(tables.model.astype(object)) @ monomial_bounds().astype(object)
    return list(zip(map(int, sums[:6]), [*map(int, sums[6:]), 0, 0, 0], strict=True))


def prove_estimator(tables: EstimatorTables, straight: float, derivative: float) -> None:
    """Prove that no measurement can overflow the model or the filter of ``filter_gains``.

    Raises:
        InputError: a channel of which a sum may reach 2^63.
    """
    for name, (total, change) in zip(CHANNELS, _sums(tables), strict=True):
        x = (total >> MODEL_BITS) + 2 + (RESIDUAL_LIMIT if tables.residual is not None else 0)
        d = (change >> DIFFERENCE_BITS) + 2 if change else 0
        y = straight * x + derivative * d
        # The memory is at most what one more sample and three products can make of it.
        largest = max(total, change, ((x + d) >> SPLIT) * tables.gain, int(8.0 * (y + x + d)))
        if largest >= 2**ROOM or y >= 2.0**FINE_BITS:
            raise InputError(
                f"estimator channel {name}: its sums may reach 2^{math.log2(largest):.1f}, "
                f"allowed: below 2^{ROOM}; take a lower cut-off"
            )


def product_fits(value: int, factor: int) -> bool:
    """Whether ``integers.multiply_shift`` of any value up to this one stays below 2^62, by bits."""
    size = abs(int(factor))
    upper = ((value >> SPLIT) + 1).bit_length() + (size + 1).bit_length()
    return upper <= ROOM and SPLIT + size.bit_length() <= ROOM


def prove_terms(tables: EstimatorTables) -> None:
    """Prove what the C proves on board: no sum of any measurement reaches 2^62, by bits of factors.

    Raises:
        InputError: a sum or a product that may.
    """
    bits = [int(bound).bit_length() for bound in monomial_bounds()]
    fine = all(
        abs(int(factor)).bit_length() + size <= ROOM
        for row in tables.model
        for factor, size in zip(row, bits, strict=True)
        if factor
    )
    for total, change in _sums(tables):
        x, d = (total >> MODEL_BITS) + 2 + RESIDUAL_LIMIT, (change >> DIFFERENCE_BITS) + 2
        fine &= max(total, change) < 2**ROOM and x + d < 2 ** (ROOM - 3)
        fine &= product_fits(2 * (x + d), tables.gain)
    fine &= all(product_fits(1 << FINE_BITS, factor) for factor in (tables.a1, tables.a2))
    if not fine:
        raise InputError(f"estimator: its sums may reach 2^{ROOM}; take a lower cut-off")


def _feedback(sample_rate: float, cutoff: float) -> tuple[int, int]:
    """a[1] and a[2] of the second-order Butterworth low-pass, Q30."""
    _, a = butter(2, cutoff, fs=sample_rate)
    return round(a[1] * (1 << Q30)), round(a[2] * (1 << Q30))


def _row(**terms: jax.Array | float) -> list[float]:
    return [float(terms.get(name, 0.0)) for name in MONOMIALS]


def _model(c: MotorConstants) -> np.ndarray:
    """Gyroscopic less model moment, and measured less model force: (6, monomials)."""
    return np.array(
        [
            _row(qr=c.i_zz - c.i_yy, roll_squares=-c.k_p, v_y=-c.k_pv),
            _row(rp=c.i_xx - c.i_zz, pitch_squares=-c.k_q, v_x=-c.k_qv),
            _row(pq=c.i_yy - c.i_xx, imbalance=-c.k_r1, r=c.k_rr),
            _row(a_x=1.0, v_x_sum=c.k_x),
            _row(a_y=1.0, v_y_sum=c.k_y),
            _row(a_z=1.0, sum_squares=c.k_w, v_z_sum=c.k_z, speed_squares=c.k_h),
        ]
    )


def _differentiated(c: MotorConstants) -> np.ndarray:
    """Angular momentum less that of the rotors' acceleration: (3, monomials)."""
    return np.array([_row(p=c.i_xx), _row(q=c.i_yy), _row(r=c.i_zz, imbalance=-c.k_r2)])


def filter_gains(sample_rate: float, cutoff: float) -> tuple[float, float]:
    """Bounds of the low-pass's and of its derivative's output over the largest input.

    The sums of the magnitudes of the impulse responses, of ``K (1 + z^-1)^2`` and ``K (1 - z^-2)``
    over the filter's denominator (the factor 2 f_s is in what is differentiated).
    """
    a1, a2 = (x / float(1 << Q30) for x in _feedback(sample_rate, cutoff))
    gain = 0.25 * (1.0 + a1 + a2)
    impulse = np.zeros(round(20.0 * sample_rate / cutoff))
    impulse[0] = gain
    responses = (lfilter(b, [1.0, a1, a2], impulse) for b in ([1.0, 2.0, 1.0], [1.0, 0.0, -1.0]))
    straight, derivative = (1.001 * float(np.abs(y).sum()) for y in responses)
    return straight, derivative


def _residual(
    residual: Residual, exponents: tuple[int, ...], channels: tuple[int, ...]
) -> FixedResidual:
    low, high = float(residual.rpm_min), float(residual.rpm_max)
    exponent = exponents[6]
    reach = max(abs(2.0 * s * 2.0**exponent - low - high) / (high - low) for s in (-1, 1))
    network = math.ceil(math.log2(reach))
    middle, factor = 0.5 * (low + high), 2.0 / (high - low)
    ranges = np.ldexp(1.0, np.array([network] * 4 + list(exponents[10:])))
    rates = np.ldexp(1.0, np.array(exponents[:3]))
    sign = float(residual.thrust_sign)
    rpm = Rescale.of(middle * (ONE / 2.0**exponent), factor * 2.0 ** (exponent - network))
    residual = residual.with_gain_in_layers()
    thrust, shift = _network("thrust", mlp.to_layers(residual.thrust), ranges, channels[5:], sign)
    ranges = np.append(ranges, rates)
    moment, shifts = _network("moment", mlp.to_layers(residual.moment), ranges, channels[:3], 1.0)
    return FixedResidual(rpm, thrust, moment, (*shift, *shifts))


def _network(
    name: str, layers: mlp.Layers, ranges: np.ndarray, channels: tuple[int, ...], sign: float
) -> tuple[tuple[FixedLayer, ...], list[int]]:
    arrays = [(np.asarray(kernel), np.asarray(bias)) for kernel, bias in layers]
    hidden, scale, magnitude = convert_hidden(arrays[:-1], ranges)
    kernel, bias = (sign * values.astype(np.float64).T for values in arrays[-1])
    weights, biases, shifts = [], [], []
    for row, exponent in enumerate(channels):
        total, power = largest_power(name, row, kernel[row], bias[row], scale, magnitude)
        power = min(power, FINE_BITS - exponent + 30)
        weights.append(np.rint(kernel[row] * scale * 2.0**power).astype(np.int64))
        biases.append(round(float(bias[row]) * 2.0**power))
        shifts.append(power - (FINE_BITS - exponent))
        if shifts[-1] < 1:
            raise InputError(f"{name} network, row {row}: outputs up to {total:.3g} are too large")
    units = np.ldexp(1.0, np.array(channels) - FINE_BITS)
    output = FixedLayer(np.array(weights), np.array(biases, np.int64), units)
    return (*hidden, output), shifts
