"""The emitted estimator of the highest propeller speed in NumPy, integer for integer."""

import dataclasses

import numpy as np

from quadjax.export.battery_tables import FINE_BITS, LIMITED, MOTORS, BatteryTables, Factor
from quadjax.export.estimator_emulator import scaled
from quadjax.export.integers import INPUT_BITS, quantize, words_of

FINE = 1 << (FINE_BITS - INPUT_BITS)  # fine units of 2^-30 of the range


@dataclasses.dataclass
class Memory:
    """Memory of the estimators of n drones, int64 in fine units."""

    speed: np.ndarray  # (n, 4)
    expected: np.ndarray  # (n, 4)
    limited: np.ndarray  # (n, 4), of 2^40 for one
    highest: np.ndarray  # (n,), the estimate

    @property
    def words(self) -> np.ndarray:
        """All of it (n, 26) uint32, of which the self-test compares a digest."""
        parts = (self.speed, self.expected, self.limited, self.highest[:, None])
        return words_of(np.concatenate(parts, axis=1))


def start(tables: BatteryTables, sample: np.ndarray) -> Memory:
    """The memory after the first sample (n, 8) float32: steady speeds, and the first estimate."""
    speed = quantize(sample, tables.exponents)[:, :MOTORS] * FINE
    first = np.full(len(sample), tables.first, np.int64)
    return Memory(speed, speed.copy(), np.zeros_like(speed), first)


def update(tables: BatteryTables, memory: Memory, sample: np.ndarray) -> None:
    """One sample (n, 8) float32: four measured speeds and four commands before it, rpm."""
    q = quantize(sample, tables.exponents) * FINE
    rpm, command, limit = q[:, :MOTORS], q[:, MOTORS:], memory.highest[:, None]

    def towards(past: np.ndarray, now: np.ndarray) -> np.ndarray:
        return past + _product(now - past, tables.low_pass)

    memory.expected = towards(memory.expected, np.minimum(command, limit))
    full = np.where(command >= limit, 1 << FINE_BITS, 0)
    memory.limited = towards(memory.limited, full)
    lead = _product(rpm - memory.speed, tables.lead)
    error = memory.speed + lead - memory.expected
    memory.speed = towards(memory.speed, rpm)
    weighted = scaled(error, memory.limited // FINE, LIMITED.shift).sum(axis=1)
    highest = memory.highest + _product(weighted, tables.gain)
    memory.highest = np.clip(highest, tables.lowest, tables.highest)


def _product(value: np.ndarray, factor: Factor) -> np.ndarray:
    return scaled(value, factor.value, factor.shift)


def output(tables: BatteryTables, memory: Memory) -> np.ndarray:
    """The estimates (n,) float32, rpm, as the C gives them."""
    upper = (memory.highest // FINE).astype(np.int32).astype(np.float32)
    return (upper * np.float32(tables.unit * FINE)).astype(np.float32)


def run(tables: BatteryTables, samples: np.ndarray) -> np.ndarray:
    """The estimates (n, time) float32, rpm, along samples (n, time, 8)."""
    memory, found = start(tables, samples[:, 0]), []
    for time in range(samples.shape[1]):
        if time:
            update(tables, memory, samples[:, time])
        found.append(output(tables, memory))
    return np.stack(found, axis=1)
