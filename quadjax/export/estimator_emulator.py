"""The emitted estimator in NumPy, integer for integer, for many drones at once."""

import dataclasses

import numpy as np

from quadjax.export.estimator_tables import (
    DIFFERENCE_BITS,
    FINE_BITS,
    LOW_PASS_BITS,
    MODEL_BITS,
    Q30,
    RESIDUAL_LIMIT,
    EstimatorTables,
    FixedResidual,
)
from quadjax.export.integers import ONE, dense, hidden_output, quantize, round_shift

SPLIT = 16  # a long product is made of an upper part and 16 lower bits


@dataclasses.dataclass
class Memory:
    """Memory of the filters of n drones, in fine units."""

    s1: np.ndarray  # (n, 6) int64
    s2: np.ndarray  # (n, 6) int64


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return round_shift(a * b, Q30)


def monomials(q: np.ndarray) -> np.ndarray:
    """The monomials (n, 19) of integer measurements (n, 13); see ``estimator_tables``."""
    g, a, w, v = q[:, 0:3].T, q[:, 3:6].T, q[:, 6:10].T, q[:, 10:13].T
    squares = [_product(x, x) for x in w]
    total = w[0] + w[1] + w[2] + w[3]
    columns = [*g, *a, v[0], v[1]]
    columns += [_product(g[1], g[2]), _product(g[2], g[0]), _product(g[0], g[1])]
    columns.append(squares[0] - squares[1] - squares[2] + squares[3])
    columns.append(squares[0] + squares[1] - squares[2] - squares[3])
    columns.append(squares[0] + squares[1] + squares[2] + squares[3])
    columns.append(-w[0] + w[1] - w[2] + w[3])
    columns += [_product(x, total) for x in v]
    columns.append(round_shift(v[0] * v[0] + v[1] * v[1], Q30))
    return np.stack(columns, axis=1)


def residual_output(network: FixedResidual, inputs: np.ndarray) -> np.ndarray:
    """What a residual network adds (n, rows), in fine units, held to half a channel's range."""
    y = inputs
    for layer in network.hidden:
        y = hidden_output(dense(y, layer.weights, layer.bias))
    sums = dense(y, network.output.weights, network.output.bias)
    columns = [round_shift(sums[:, i], shift) for i, shift in enumerate(network.shifts)]
    return np.clip(np.stack(columns, axis=1), -RESIDUAL_LIMIT, RESIDUAL_LIMIT)


def unexplained(tables: EstimatorTables, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What goes into the filters: (n, 6), and what is differentiated, (n, 6), in fine units."""
    m = monomials(q)
    x = round_shift(m @ tables.model.T, MODEL_BITS)
    d = np.zeros_like(x)
    d[:, :3] = round_shift(m @ tables.differentiated.T, DIFFERENCE_BITS)
    if tables.thrust is not None and tables.moment is not None and tables.rpm_input is not None:
        r = tables.rpm_input
        rpm = round_shift((q[:, 6:10] - r.middle) * r.factor, r.shift)
        rpm = np.clip(rpm, -ONE, ONE)
        inputs = np.concatenate([rpm, q[:, 10:13]], axis=1)
        x[:, 5] -= residual_output(tables.thrust, inputs)[:, 0]
        with_rates = np.concatenate([inputs, q[:, 0:3]], axis=1)
        x[:, :3] -= residual_output(tables.moment, with_rates)
    return x, d


def scaled(value: np.ndarray, factor: int, bits: int) -> np.ndarray:
    """``value factor / 2^bits`` to the nearest, of a product that needs more than 64 bits."""
    upper, lower = value >> SPLIT, value & ((1 << SPLIT) - 1)
    return round_shift(upper * factor + ((lower * factor) >> SPLIT), bits - SPLIT)


def start(tables: EstimatorTables, measured: np.ndarray) -> Memory:
    """The memory before the first sample (n, 13): no disturbance, all steady until now."""
    _, d = unexplained(tables, quantize(measured, tables.exponents))
    before = -scaled(d, tables.gain, LOW_PASS_BITS)
    return Memory(before, before.copy())


def update(tables: EstimatorTables, memory: Memory, measured: np.ndarray) -> np.ndarray:
    """One sample (n, 13): the external moment and specific force (n, 6), in fine units."""
    x, d = unexplained(tables, quantize(measured, tables.exponents))
    limit = 1 << FINE_BITS  # never reached: the converter bounds the output by the range
    y = np.clip(scaled(x + d, tables.gain, LOW_PASS_BITS) + memory.s1, -limit, limit)
    memory.s1 = memory.s2 + scaled(2 * x, tables.gain, LOW_PASS_BITS) - scaled(y, tables.a1, Q30)
    memory.s2 = scaled(x - d, tables.gain, LOW_PASS_BITS) - scaled(y, tables.a2, Q30)
    return y


def outputs(tables: EstimatorTables, y: np.ndarray) -> np.ndarray:
    """Fine units (n, 6) as float32: N m and m/s^2, as the C gives them."""
    units = np.ldexp(1.0, np.asarray(tables.channel_exponents) - Q30)
    upper = (y >> (FINE_BITS - Q30)).astype(np.int32)
    return (upper.astype(np.float32) * units.astype(np.float32)).astype(np.float32)
