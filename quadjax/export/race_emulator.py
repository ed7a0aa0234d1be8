"""The emitted observation and gate logic in NumPy, integer for integer."""

import dataclasses

import numpy as np

from quadjax.export.fixed import LARGEST_INPUT
from quadjax.export.race_tables import TURN_BITS, YAW_EXPONENT, RaceTables, Rescale

ROTATION_BITS = 30


@dataclasses.dataclass(frozen=True)
class Observed:
    """Network inputs, and what was clipped or NaN on the way."""

    q: np.ndarray  # (n, inputs) int32
    clipped: np.ndarray  # (n,) uint32, bit i: number i of the state
    nan: np.ndarray  # (n,) uint32, bit i: number i of the state
    outside: np.ndarray  # (n,) uint32, bit i: input i of the network


def quantize_state(
    tables: RaceTables, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (n, state_size) float32 as integers (n, state_size), and the masks (n,)."""
    given = np.asarray(states, np.float32)
    nan = np.isnan(given)
    x = np.where(nan, np.float32(0), given).astype(np.float64)
    limit = np.ldexp(1.0, np.asarray(tables.exponents))
    clipped = np.abs(x) > limit
    q = np.trunc(np.clip(x, -limit, limit) * (LARGEST_INPUT / limit)).astype(np.int64)
    bits = np.uint32(1) << np.arange(tables.state_size, dtype=np.uint32)
    return q, (clipped * bits).sum(1, dtype=np.uint32), (nan * bits).sum(1, dtype=np.uint32)


def observe(tables: RaceTables, states: np.ndarray, target: np.ndarray) -> Observed:
    """Network inputs of states (n, state_size) float32 towards gates ``target`` (n,)."""
    q, clipped, nan = quantize_state(tables, states)
    raw = np.stack(_inputs(tables, q, np.asarray(target)), axis=1)
    held = np.clip(raw, -LARGEST_INPUT, LARGEST_INPUT)
    bits = np.uint32(1) << np.arange(raw.shape[1], dtype=np.uint32)
    outside = ((held != raw) * bits).sum(1, dtype=np.uint32)
    return Observed(held.astype(np.int32), clipped, nan, outside)


def _inputs(tables: RaceTables, q: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    network = tables.network_exponents
    cosine, sine = tables.gate_cos[target], tables.gate_sin[target]
    offset = q[:, 0:3] - tables.gate_position[target]
    columns = _rotate(offset, cosine, sine, ROTATION_BITS - tables.exponents[0] + network[0])
    columns += _rotate(q[:, 3:6], cosine, sine, ROTATION_BITS - tables.exponents[3] + network[3])
    columns += [q[:, 6], q[:, 7]]
    yaw = (q[:, 8] << YAW_EXPONENT) - tables.gate_yaw[target]
    columns.append(_round_shift(wrap(tables, yaw), network[8]))
    columns += [q[:, 9], q[:, 10], q[:, 11]]
    numbers = [q[:, index] for index in range(12, q.shape[1])]
    if tables.vehicle == "motor":  # of the external force only the z component
        numbers = numbers[:-3] + numbers[-1:]
    scaled = [_rescaled(r, x) for r, x in zip(tables.scaled, numbers, strict=True)]
    actuators = 4 if tables.vehicle == "motor" else 1
    following = [tables.next_gate[target, index] for index in range(4)]
    return columns + scaled[:actuators] + following + scaled[actuators:]


def _rotate(vector: np.ndarray, cosine: np.ndarray, sine: np.ndarray, shift: int) -> list:
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    return [
        _round_shift(cosine * x + sine * y, shift),
        _round_shift(cosine * y - sine * x, shift),
        _round_shift(z << ROTATION_BITS, shift),
    ]


def _round_shift(value: np.ndarray, shift: int) -> np.ndarray:
    if shift <= 0:
        return value << -shift
    return (value + (1 << (shift - 1))) >> shift


def wrap(tables: RaceTables, yaw: np.ndarray) -> np.ndarray:
    """A yaw in Q30 within half a turn, by one multiplication."""
    units = yaw >> YAW_EXPONENT
    turns = (units * tables.turns_per_unit + (1 << (TURN_BITS - 1))) >> TURN_BITS
    return yaw - turns * tables.two_pi


def _rescaled(rescale: Rescale | None, value: np.ndarray) -> np.ndarray:
    if rescale is None:
        return np.zeros_like(value)
    return _round_shift((value - rescale.middle) * rescale.factor, rescale.shift)


NO_EVENT, PASSED, MISSED = 0, 1, 2


def gate_event(
    tables: RaceTables, before: np.ndarray, after: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """What steps from positions ``before`` to ``after`` (n, 3), integers, led to, (n,)."""
    cosine, sine = tables.gate_cos[target], tables.gate_sin[target]
    old = before - tables.gate_position[target]
    new = after - tables.gate_position[target]
    was = cosine * old[:, 0] + sine * old[:, 1]
    _, y, z = _rotate(new, cosine, sine, ROTATION_BITS)
    now = cosine * new[:, 0] + sine * new[:, 1]
    half = tables.half_size[target]
    if tables.world_box:
        aside = np.maximum(np.abs(new[:, 0]), np.abs(new[:, 1]))
        inside = (aside < half[:, 0]) & (np.abs(new[:, 2]) < half[:, 1])
    else:
        inside = (np.abs(y) <= half[:, 0]) & (np.abs(z) <= half[:, 1])
    crossed = (was < 0) & (now >= 0)
    return np.where(crossed, np.where(inside, PASSED, MISSED), NO_EVENT)
