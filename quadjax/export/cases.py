"""Self-test cases of a policy, which its words contain, and vectors for the verification.

The cases are inputs and the integers that follow from them, computed by the emulators.
"""

import dataclasses

import numpy as np

from quadjax.export import emulator
from quadjax.export.battery import MOTORS, BatteryTables
from quadjax.export.disturbances import CHANNELS, EstimatorTables
from quadjax.export.estimator_emulator import Battery, estimate
from quadjax.export.integers import ONE, digest, quantize
from quadjax.export.network import FixedNetwork
from quadjax.export.race_tables import RaceTables

CORNERS, SIMULATED, RANDOM = 8, 16, 8
RANDOM_STATES, SIMULATED_STATES = 6, 10
MEASUREMENTS, SAMPLES = 16, 64  # of an estimator: the measurements are repeated


@dataclasses.dataclass(frozen=True)
class Tables:
    """Integers of a policy, proven, from which the self-tests follow."""

    network: FixedNetwork  # of a file: without the real values of its units
    race: RaceTables
    estimator: EstimatorTables | None  # of the disturbances
    battery: BatteryTables | None  # of the highest rpm


@dataclasses.dataclass(frozen=True)
class Cases:
    """Self-tests of a policy, of 32-bit words (rows, columns); without an estimator no rows of it.

    Commands and traces follow from the inputs, what is observed and its status from states and
    target gates, estimates from repeated measurements, digests from repeated samples.
    """

    inputs: np.ndarray  # (n, inputs) int32, of the network
    commands: np.ndarray  # (n, outputs) int32
    traces: np.ndarray  # (n, 1) digest of every accumulator
    states: np.ndarray  # (m, state_size) the bits
    targets: np.ndarray  # (m, 1)
    observed: np.ndarray  # (m, inputs) int32
    status: np.ndarray  # (m, 3) clipped, nan, outside
    measurements: np.ndarray  # (MEASUREMENTS, 13) the bits
    estimates: np.ndarray  # (SAMPLES, 6) the bits of moment and force after each
    samples: np.ndarray  # (MEASUREMENTS, 8) the bits
    digests: np.ndarray  # (SAMPLES, 1) of the battery's memory after each


def make_cases(
    tables: Tables, observations: np.ndarray | None, states: np.ndarray, targets: np.ndarray
) -> Cases:
    """The self-tests of a policy.

    Args:
        tables: of the policy.
        observations: (n, inputs) simulated observations, if there are any.
        states: (n, state_size) simulated states.
        targets: (n,) the target gate of each.
    """
    rng, race = np.random.default_rng(0), tables.race
    ranges = np.ldexp(1.0, np.asarray(race.exponents))
    random = rng.uniform(-0.5, 0.5, (RANDOM_STATES, len(ranges))) * ranges
    random = random.astype(np.float32)
    random[0] *= np.float32(10.0)
    random[1, :] = np.nan
    gates = rng.integers(0, race.gates, RANDOM_STATES)
    pick = np.linspace(0, len(states) - 1, SIMULATED_STATES if len(states) else 0).astype(int)
    states = states if len(states) else random[:0]
    return answered(
        tables,
        _inputs(tables.network, observations),
        np.concatenate([random, states[pick].astype(np.float32)]),
        np.concatenate([gates, np.ravel(targets)[pick]]).astype(int),
        _measurements(tables.estimator),
        _samples(tables.battery),
    )


def answered(
    tables: Tables,
    inputs: np.ndarray,
    states: np.ndarray,
    targets: np.ndarray,
    measurements: np.ndarray,
    samples: np.ndarray,
) -> Cases:
    """The cases of inputs int32, states float32 and targets, and of the estimators' samples."""
    race, rows = tables.race, emulator.forward_rows(tables.network, inputs)
    gates = np.where((targets >= 0) & (targets < race.gates), targets, 0)
    observed, status = emulator.observe(race, states, gates)
    arrays = {
        "inputs": inputs,
        "commands": rows[:, :-1],
        "traces": rows[:, -1:],
        "states": states,
        "targets": targets[:, None].astype(np.uint32),
        "observed": observed,
        "status": status,
        "measurements": measurements,
        "estimates": _estimates(tables.estimator, measurements),
        "samples": samples,
        "digests": _digests(tables.battery, samples),
    }
    return Cases(**{name: np.ascontiguousarray(x).view(np.uint32) for name, x in arrays.items()})


def _measurements(tables: EstimatorTables | None) -> np.ndarray:
    """Random measurements (MEASUREMENTS, 13) float32, one clipped and one with a NaN."""
    if tables is None:
        return np.zeros((0, 13), np.float32)
    rng, limit = np.random.default_rng(0), np.ldexp(1.0, np.asarray(tables.exponents))
    rows = rng.uniform(-0.3, 0.3, (MEASUREMENTS, len(limit))) * limit
    rows[:, 6:10] = np.abs(rows[:, 6:10]) * 2.0
    rows[-1] *= 8.0  # clipped
    rows[-2, 2] = np.nan
    return rows.astype(np.float32)


def _estimates(tables: EstimatorTables | None, measured: np.ndarray) -> np.ndarray:
    """The estimates (SAMPLES, 6) float32 along repeated measurements."""
    if tables is None:
        return np.zeros((0, len(CHANNELS)), np.float32)
    return estimate(tables, measured[np.arange(SAMPLES) % MEASUREMENTS])


def _samples(tables: BatteryTables | None) -> np.ndarray:
    """Samples (MEASUREMENTS, 8) float32: commands below and at the limit, one clipped, some NaN."""
    if tables is None:
        return np.zeros((0, 2 * MOTORS), np.float32)
    rng = np.random.default_rng(0)
    shape, top = (MEASUREMENTS, MOTORS), tables.highest * tables.unit
    command = np.where(rng.random(shape) < 0.5, 1.0, rng.uniform(0.3, 1.0, shape)) * top
    rows = np.concatenate([rng.uniform(0.7, 1.0, shape) * top, command], axis=1)
    rows[-1] *= 8.0  # clipped
    rows[-2, 2] = rows[-3, 6] = np.nan
    return rows.astype(np.float32)


def _digests(tables: BatteryTables | None, samples: np.ndarray) -> np.ndarray:
    """Digests (SAMPLES, 1) uint32 of the estimator's memory after each of repeated samples."""
    if tables is None:
        return np.zeros((0, 1), np.uint32)
    battery, digests = Battery(tables, samples[:1]), []
    for number in range(SAMPLES):
        if number and number % (MEASUREMENTS // 2) == 0:  # to both limits of the estimate
            battery.highest[:] = tables.highest if number % MEASUREMENTS else tables.lowest
        if number:
            battery.update(samples[number % MEASUREMENTS][None])
        digests.append(digest(battery.memory))
    return np.array(digests, np.uint32)


def _inputs(network: FixedNetwork, observations: np.ndarray | None) -> np.ndarray:
    """Inputs (n, inputs) int32: corners of the box, simulated ``observations``, random ones."""
    rng = np.random.default_rng(0)
    signs = rng.choice([-1, 1], (CORNERS, network.inputs))
    signs[0], signs[1] = 1, -1
    parts, random = [signs * ONE], RANDOM + SIMULATED
    if observations is not None and len(observations):
        pick = np.linspace(0, len(observations) - 1, SIMULATED).astype(int)
        parts.append(quantize(observations[pick], network.box.exponents))
        random = RANDOM
    parts.append(rng.integers(-ONE, ONE + 1, (random, network.inputs)))
    return np.concatenate(parts).astype(np.int32)


def check_vectors(
    network: FixedNetwork, count: int, observations: np.ndarray | None, seed: int = 0
) -> np.ndarray:
    """Observations (count, inputs) float32: corners, simulated, uniform, Gaussian.

    A quarter each. Corners are -range, 0 or +range in every input; the simulated ``observations``
    are repeated with noise of one percent; the Gaussian ones have a standard deviation of half the
    range, so that some of them leave the box.
    """
    rng = np.random.default_rng(seed)
    ranges = network.box.ranges
    quarter = count // 4
    shape = (quarter, network.inputs)
    corners = rng.integers(-1, 2, shape) * ranges
    uniform = rng.uniform(-1.0, 1.0, shape) * ranges
    gaussian = rng.standard_normal((count - 3 * quarter, network.inputs)) * 0.5 * ranges
    if observations is not None and len(observations):
        repeated = observations[rng.integers(0, len(observations), quarter)]
        repeated = repeated + 0.01 * ranges * rng.standard_normal(shape)
        repeated[: len(observations)] = observations[:quarter]
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


def uniform_samples(network: FixedNetwork, count: int, seed: int) -> np.ndarray:
    """Observations (count, inputs) float32, uniform in the declared ranges."""
    rng = np.random.default_rng(seed)
    shape = (count, network.inputs)
    return (rng.uniform(-1.0, 1.0, shape) * network.box.ranges).astype(np.float32)
