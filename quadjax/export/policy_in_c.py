"""A policy and its race as numbers: padded tables, their hash, and the self-tests."""

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np

from quadjax.export.estimators import BatteryModel, DisturbanceModel
from quadjax.export.integers import ONE, WORD, hash_words
from quadjax.export.network import FixedLayer, FixedNetwork
from quadjax.export.observation import FIELD_NAMES, GATE_TESTS, Observation
from quadjax.export.suitability import kind_of
from quadjax.export.targets import MOTOR, RATES, RPM

BLOCK = 4  # rows of a block of weights
MULTIPLE = 8  # columns, and rows of a hidden layer, are padded to a multiple of this
CORNERS, RANDOM = 4, 12  # self-tests
COMMANDS = 4


@dataclasses.dataclass(frozen=True)
class PolicyInC:
    """A policy and its race as numbers: what ``NAME.h`` contains."""

    name: str
    network: FixedNetwork
    observation: Observation
    disturbance: DisturbanceModel | None
    battery: BatteryModel | None
    noise: np.ndarray | None  # (commands,) standard deviation, of a policy that samples its actions
    noise_on_clamped: bool

    @property
    def actions(self) -> str:
        """How its actions are chosen, as text."""
        return "deterministic (mean)" if self.noise is None else "sampled"

    @property
    def sample_rate(self) -> float | None:
        """Of the estimators, Hz; None without."""
        model = self.disturbance or self.battery
        return None if model is None else model.sample_rate

    @functools.cached_property
    def tables(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Weights (words,) int32 and biases (rows,) int64 of each layer, padded, as in C."""
        *hidden, output = self.network.layers
        shift = self.network.output_shift
        return (*(_table(layer, WORD, True) for layer in hidden), _table(output, shift, False))

    @property
    def hash(self) -> int:
        """Hash of all tables and numbers, as ``qj_self_test`` computes it."""
        network, o = self.network, self.observation
        kind = (RPM, MOTOR, RATES).index(kind_of(network.model.name))
        numbers = [1 + kind, network.inputs]
        numbers += [len(network.layers), len(o.parts), len(o.gates), o.constants.shape[1]]
        numbers += [network.output_shift, network.fraction_bits, GATE_TESTS.index(o.gate_test)]
        gates = np.column_stack([o.gates.view(np.uint32).reshape(len(o.gates), -1), o.is_round])
        ranges = network.box.ranges.astype(np.float32)
        fields = [(1 + FIELD_NAMES.index(name), size) for name, size in o.parts]
        parts = [
            np.array([*numbers, self.noise_on_clamped], np.uint32),
            np.array([o.time_step], np.float32),
            np.array([network.command_low, network.command_high], np.int32).ravel(),
            *(array for pair in self.tables for array in pair),
            np.array(fields, np.uint32).ravel(),
            np.column_stack([o.scales, ranges]).astype(np.float32).ravel(),
            gates.astype(np.uint32).ravel(),
            o.constants.ravel(),
            *(np.asarray(x, np.float32).ravel() for x in self._estimator_numbers()),
        ]
        return hash_words(np.concatenate([part.view(np.uint32) for part in parts]))

    def _estimator_numbers(self) -> Iterable[object]:
        """The floats of the estimators and of the noise, in the order of the hash."""
        if (model := self.disturbance) is not None:
            yield [model.sample_rate, *model.constants.values(), *model.inertia]
            yield [*model.feedback, *model.low_pass, *model.derivative]
            if (residual := model.residual) is not None:
                yield [residual.low_rpm, residual.high_rpm]
                yield from (x for layer in (*residual.thrust, *residual.moment) for x in layer)
        if self.battery is not None:
            yield list(vars(self.battery).values())
        if self.noise is not None:
            yield self.noise

    @functools.cached_property
    def test_inputs(self) -> np.ndarray:
        """Inputs (n, inputs) int32 of the self-tests: corners of the box, and random ones."""
        rng, count = np.random.default_rng(0), self.network.inputs
        signs = rng.choice([-1, 1], (CORNERS, count))
        signs[0], signs[1] = 1, -1
        random = rng.integers(-ONE, ONE + 1, (RANDOM, count))
        return np.concatenate([signs * ONE, random]).astype(np.int32)


def padded(rows: int, columns: int, hidden: bool) -> tuple[int, int]:
    """The shape of a layer's table in C."""
    multiple = MULTIPLE if hidden else BLOCK
    return -(-rows // multiple) * multiple, -(-columns // MULTIPLE) * MULTIPLE


def _table(layer: FixedLayer, shift: int, hidden: bool) -> tuple[np.ndarray, np.ndarray]:
    """Weights in the order of the kernels and biases; padded rows hold the rounding half."""
    rows, columns = layer.weights.shape
    height, width = padded(rows, columns, hidden)
    weights = np.zeros((height, width), np.int32)
    weights[:rows, :columns] = layer.weights
    bias = np.full(height, 2 ** (shift - 1), np.int64)
    bias[:rows] = layer.bias
    return weights.reshape(-1, BLOCK, width).transpose(0, 2, 1).ravel(), bias
