"""The exported estimators in NumPy, integer for integer, for many drones at once."""

from collections.abc import Sequence

import numpy as np

from quadjax.export.battery import FINE_BITS as BATTERY_BITS
from quadjax.export.battery import MOTORS, BatteryTables
from quadjax.export.disturbances import (
    DIFFERENCE_BITS,
    FINE_BITS,
    LOW_PASS_BITS,
    MODEL_BITS,
    Q30,
    RESIDUAL_LIMIT,
    EstimatorTables,
)
from quadjax.export.integers import (
    INPUT_BITS,
    ONE,
    dense,
    hidden_output,
    multiply_shift,
    quantize,
    round_shift,
)
from quadjax.export.network import FixedLayer

FINE = 1 << (BATTERY_BITS - INPUT_BITS)  # fine units of the battery's in 2^-30 of the range


def monomials(q: np.ndarray) -> np.ndarray:
    """The monomials (n, 19) of integer measurements (n, 13), in the order of ``MONOMIALS``."""

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return round_shift(a * b, Q30)

    g, a, w, v = q[:, 0:3].T, q[:, 3:6].T, q[:, 6:10].T, q[:, 10:13].T
    squares = [product(x, x) for x in w]
    total = w[0] + w[1] + w[2] + w[3]
    columns = [*g, *a, v[0], v[1]]
    columns += [product(g[1], g[2]), product(g[2], g[0]), product(g[0], g[1])]
    columns.append(squares[0] - squares[1] - squares[2] + squares[3])
    columns.append(squares[0] + squares[1] - squares[2] - squares[3])
    columns.append(squares[0] + squares[1] + squares[2] + squares[3])
    columns.append(-w[0] + w[1] - w[2] + w[3])
    columns += [product(x, total) for x in v]
    columns.append(round_shift(v[0] * v[0] + v[1] * v[1], Q30))
    return np.stack(columns, axis=1)


def residual_output(
    layers: Sequence[FixedLayer], shifts: Sequence[int], inputs: np.ndarray
) -> np.ndarray:
    """What a residual network adds (n, rows), in fine units, held to half a channel's range."""
    y = inputs
    for layer in layers[:-1]:
        y = hidden_output(dense(y, layer.weights, layer.bias))
    sums = dense(y, layers[-1].weights, layers[-1].bias)
    columns = [round_shift(sums[:, i], shift) for i, shift in enumerate(shifts)]
    return np.clip(np.stack(columns, axis=1), -RESIDUAL_LIMIT, RESIDUAL_LIMIT)


class Filters:
    """The estimator of n drones, whose filters have the memory ``s1``, ``s2`` (n, 6) int64."""

    def __init__(self, tables: EstimatorTables, measured: np.ndarray) -> None:
        """No disturbance before the first sample (n, 13) float32, all steady until now."""
        self._tables = tables
        _, d = self._unexplained(measured)
        self.s1 = -multiply_shift(d, tables.gain, LOW_PASS_BITS)
        self.s2 = self.s1.copy()

    def _unexplained(self, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What goes into the filters (n, 6), and what is differentiated (n, 6), in fine units."""
        tables, q = self._tables, quantize(measured, self._tables.exponents)
        sums = monomials(q) @ tables.model.T
        x = round_shift(sums[:, :6], MODEL_BITS)
        d = np.zeros_like(x)
        d[:, :3] = round_shift(sums[:, 6:], DIFFERENCE_BITS)
        if (residual := tables.residual) is not None:
            rpm = np.clip(residual.rpm.apply(q[:, 6:10]), -ONE, ONE)
            inputs, shifts = np.concatenate([rpm, q[:, 10:13]], axis=1), residual.shifts
            x[:, 5] -= residual_output(residual.thrust, shifts[:1], inputs)[:, 0]
            inputs = np.append(inputs, q[:, 0:3], axis=1)
            x[:, :3] -= residual_output(residual.moment, shifts[1:], inputs)
        return x, d

    def update(self, measured: np.ndarray) -> np.ndarray:
        """Moments and specific forces (n, 6) float32, N m and m/s^2, after a sample (n, 13)."""
        tables, (x, d) = self._tables, self._unexplained(measured)
        limit = 1 << FINE_BITS  # never reached: the converter bounds the output by the range
        y = np.clip(multiply_shift(x + d, tables.gain, LOW_PASS_BITS) + self.s1, -limit, limit)
        straight = multiply_shift(2 * x, tables.gain, LOW_PASS_BITS)
        self.s1 = self.s2 + straight - multiply_shift(y, tables.a1, Q30)
        self.s2 = multiply_shift(x - d, tables.gain, LOW_PASS_BITS) - multiply_shift(
            y, tables.a2, Q30
        )
        units = np.ldexp(1.0, np.asarray(tables.channel_exponents) - Q30)
        upper = (y >> (FINE_BITS - Q30)).astype(np.int32)
        return (upper.astype(np.float32) * units.astype(np.float32)).astype(np.float32)


def estimate(tables: EstimatorTables, log: np.ndarray) -> np.ndarray:
    """Moments and specific forces (n, 6) float32 along measurements (n, 13) float32."""
    filters = Filters(tables, log[:1])
    return np.concatenate([filters.update(sample[None]) for sample in log])


class Battery:
    """The estimator of the highest speed of n drones; its memory is int64 in fine units.

    Attributes:
        speed: (n, 4).
        expected: (n, 4).
        limited: (n, 4), of 2^40 for one.
        highest: (n,), the estimate.
    """

    def __init__(self, tables: BatteryTables, sample: np.ndarray) -> None:
        """Steady speeds of the first sample (n, 8) float32, and the first estimate."""
        self._tables = tables
        self.speed = quantize(sample, tables.exponents)[:, :MOTORS] * FINE
        self.expected, self.limited = self.speed.copy(), np.zeros_like(self.speed)
        self.highest = np.full(len(sample), tables.first, np.int64)

    @property
    def memory(self) -> np.ndarray:
        """All of it (n, 13), of which the self-test compares a digest."""
        parts = (self.speed, self.expected, self.limited, self.highest[:, None])
        return np.concatenate(parts, axis=1)

    @property
    def rpm(self) -> np.ndarray:
        """The estimates (n,) float32, rpm, as the C gives them."""
        upper = (self.highest // FINE).astype(np.int32).astype(np.float32)
        return (upper * np.float32(self._tables.unit * FINE)).astype(np.float32)

    def update(self, sample: np.ndarray) -> None:
        """One sample (n, 8) float32: four measured speeds and four commands before it, rpm."""
        tables, q = self._tables, quantize(sample, self._tables.exponents) * FINE
        rpm, command, limit = q[:, :MOTORS], q[:, MOTORS:], self.highest[:, None]

        def towards(past: np.ndarray, now: np.ndarray) -> np.ndarray:
            return past + multiply_shift(now - past, tables.low_pass, tables.low_pass_shift)

        self.expected = towards(self.expected, np.minimum(command, limit))
        self.limited = towards(self.limited, np.where(command >= limit, 1 << BATTERY_BITS, 0))
        lead = multiply_shift(rpm - self.speed, tables.lead, tables.lead_shift)
        error = self.speed + lead - self.expected
        self.speed = towards(self.speed, rpm)
        weighted = multiply_shift(error, self.limited // FINE, INPUT_BITS).sum(axis=1)
        highest = self.highest + multiply_shift(weighted, tables.gain, tables.gain_shift)
        self.highest = np.clip(highest, tables.lowest, tables.highest)


def estimate_highest(tables: BatteryTables, log: np.ndarray) -> np.ndarray:
    """The estimates (n,) float32, rpm, along samples (n, 8)."""
    battery = Battery(tables, log[:1])
    estimates = [battery.rpm]
    for sample in log[1:]:
        battery.update(sample[None])
        estimates.append(battery.rpm)
    return np.concatenate(estimates)
