"""The emitted observation and gate logic in NumPy, integer for integer."""

import dataclasses

import numpy as np

from quadjax.export import integers
from quadjax.export.integers import INPUT_BITS, ONE, round_shift
from quadjax.export.race_tables import (
    ATTITUDE,
    COPY,
    GATE,
    POSITION,
    QUATERNION_EXPONENT,
    ROTATION,
    SCALED,
    TURN_BITS,
    TURNS_PER_UNIT,
    TWO_PI,
    YAW_EXPONENT,
    Input,
    RaceTables,
)
from quadjax.export.scaling import Rescale

NO_EVENT, PASSED, MISSED = 0, 1, 2


@dataclasses.dataclass(frozen=True)
class Observed:
    """Network inputs, and what was clipped or NaN on the way."""

    q: np.ndarray  # (n, inputs) int32
    clipped: np.ndarray  # (n,) uint32, bit i: number i of the state
    nan: np.ndarray  # (n,) uint32, bit i: number i of the state
    outside: np.ndarray  # (n,) uint32, bit i: input i of the network


def observe(tables: RaceTables, states: np.ndarray, target: np.ndarray) -> Observed:
    """Network inputs of states (n, state_size) float32 towards gates ``target`` (n,).

    Where a history is observed, the states are those of one flight from its start on.
    """
    q = integers.quantize(states, tables.exponents)
    raw = np.concatenate(_inputs(tables, q, np.asarray(target)), axis=1)
    held = np.clip(raw, -ONE, ONE)
    masks = integers.status_masks(states, tables.exponents)
    return Observed(held.astype(np.int32), *masks, integers.bit_mask(held != raw))


def _inputs(tables: RaceTables, q: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """The inputs before clipping, (n, size) of each field of the observation."""
    return [_input(tables, part, q, target) for part in tables.inputs]


def _input(tables: RaceTables, part: Input, q: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The inputs (n, size) of one field."""
    if part.kind == GATE:
        return tables.next_gate[target][:, part.sources]
    then = np.maximum(np.arange(len(q)) - part.lag, 0)
    values, network = q[then][:, part.sources], tables.box.exponent[part.name]
    if part.kind == SCALED:
        pairs = zip(part.rescales, values.T, strict=True)
        return np.stack([_rescaled(r, value) for r, value in pairs], axis=1)
    if part.kind == ATTITUDE:
        yaw = (values[:, 2] << YAW_EXPONENT) - tables.gate_yaw[target]
        return np.column_stack([values[:, :2], round_shift(wrap(yaw), network)])
    if part.kind == COPY:
        return values
    if part.kind == ROTATION:
        return _rotation(tables, values, target, network)
    if part.kind == POSITION:
        values = values - tables.gate_position[target]
    shift = INPUT_BITS - tables.exponent(part.kind) + network
    rotated = _rotate(values, tables.gate_cos[target], tables.gate_sin[target])
    return np.stack([round_shift(x, shift) for x in rotated], axis=1)


def _rotation(tables: RaceTables, q: np.ndarray, target: np.ndarray, network: int) -> np.ndarray:
    """The body's x and z axes (n, 6) in the gate's frame, of quaternions (n, 4)."""
    columns = []
    for axis in axes_of(q):
        rotated = _rotate(axis, tables.gate_cos[target], tables.gate_sin[target])
        columns += [round_shift(x, INPUT_BITS + network) for x in rotated]
    return np.stack(columns, axis=1)


def axes_of(q: np.ndarray) -> list[np.ndarray]:
    """The body's x and z axes, each (n, 3) in Q30, of quaternions (n, 4) with the range +-2."""
    w, x, y, z = q.T
    one = np.int64(1) << (2 * (INPUT_BITS - QUATERNION_EXPONENT))
    front = (one - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    down = (2 * (x * z + w * y), 2 * (y * z - w * x), one - 2 * (x * x + y * y))
    shift = INPUT_BITS - 2 * QUATERNION_EXPONENT
    return [
        np.stack([np.clip(round_shift(x, shift), -2 * ONE, 2 * ONE) for x in axis], axis=1)
        for axis in (front, down)
    ]


def _rotate(vector: np.ndarray, cosine: np.ndarray, sine: np.ndarray) -> list[np.ndarray]:
    """Through the gate, to its right and down, in Q30 of the vector's units."""
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    return [cosine * x + sine * y, cosine * y - sine * x, z << INPUT_BITS]


def wrap(yaw: np.ndarray) -> np.ndarray:
    """A yaw in Q30 within half a turn, by one multiplication."""
    turns = ((yaw >> YAW_EXPONENT) * TURNS_PER_UNIT + (1 << (TURN_BITS - 1))) >> TURN_BITS
    return yaw - turns * TWO_PI


def _rescaled(rescale: Rescale | None, value: np.ndarray) -> np.ndarray:
    if rescale is None:
        return np.zeros_like(value)
    return round_shift((value - rescale.middle) * rescale.factor, rescale.shift)


def gate_event(
    tables: RaceTables, before: np.ndarray, after: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """The event (n,) of steps from positions ``before`` to ``after`` (n, 3), integers."""
    old = before - tables.gate_position[target]
    new = after - tables.gate_position[target]
    was, now = (_in_opening(tables, x, target) for x in (old, new))
    half = tables.half_size[target]
    if tables.world_box:
        aside = np.maximum(np.abs(new[:, 0]), np.abs(new[:, 1]))
        inside = (aside < half[:, 0]) & (np.abs(new[:, 2]) < half[:, 1])
    else:
        right, down = (np.abs(round_shift(x, INPUT_BITS)) for x in now[1:])
        inside = (right <= half[:, 0]) & (down <= half[:, 1])
        if tables.circle is not None:
            right, down = (np.minimum(x, half[:, 0]) for x in (right, down))
            within = right * right + down * down <= half[:, 0] * half[:, 0]
            inside &= within | ~tables.circle[target]
    crossed = (was[0] < 0) & (now[0] >= 0)
    return np.where(crossed, np.where(inside, PASSED, MISSED), NO_EVENT)


def _in_opening(tables: RaceTables, vector: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """Along the gate's own axes, in Q30 of the vector's units."""
    if tables.axes is None:
        return _rotate(vector, tables.gate_cos[target], tables.gate_sin[target])
    return list(np.einsum("nij,nj->in", tables.axes[target], vector))
