"""The fixed-point format: a float policy as integer tables.

With ``x`` an input and ``2**e`` its range, ``q = trunc(x 2**(30 - e))``. A hidden neuron ``i`` of
scale ``s_i`` (the real value of one unit of its output) has::

    w_ij = round(W_ij s_j 2**32 / s_i)          int32
    b_i  = round(B_i 2**32 / s_i) + 2**31       int64, the rounding half folded in
    y_i  = max(0, b_i + sum_j w_ij y_j >> 32)   int32, at most 2**30 - 1

so that ReLU, rounding and requantization are one shift by a whole word. The output layer has the
map from action to command folded in and one power-of-two scale for all rows.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.integers import INPUT_BITS, ONE, WORD
from quadjax.export.ranges import InputBox, declare
from quadjax.policy.file import Policy
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import MODELS

FORMAT_VERSION = 1
LARGEST_HIDDEN = 2**INPUT_BITS - 1
LARGEST_WEIGHT = 2**31 - 1
# Scales leave this many units of headroom, and one per column, for the rounding of weights.
HEADROOM = 257
LARGEST_SHIFT = 32  # of the output: its clamp limits stay below 2^63


@dataclasses.dataclass(frozen=True)
class FixedLayer:
    """Integers of one dense layer; row ``i`` is output ``i``."""

    weights: np.ndarray  # (rows, columns) int32
    bias: np.ndarray  # (rows,) int64, rounding half folded in
    scale: np.ndarray  # (rows,) float64, real value of one unit of the output


@dataclasses.dataclass(frozen=True)
class FixedNetwork:
    """A policy as integers: what the emulators run and the C contains."""

    box: InputBox
    hidden: tuple[FixedLayer, ...]
    output: FixedLayer
    output_shift: int  # from the output accumulator to its int32
    fraction_bits: int  # of a command: command = integer / 2**fraction_bits
    command_low: np.ndarray  # (outputs,) int64, in units of 2**-fraction_bits
    command_high: np.ndarray  # (outputs,) int64
    model: VehicleModel

    @property
    def rpm(self) -> bool:
        """Whether the commands are propeller speeds, which the C gives as integers."""
        return commands_rpm(self.model)

    @property
    def unit(self) -> str:
        """The units of the commands."""
        return " and ".join(dict.fromkeys(signal.unit for signal in self.model.commands))

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return len(self.box.exponents)

    @property
    def outputs(self) -> int:
        """Number of commands."""
        return len(self.output.bias)

    @property
    def layers(self) -> tuple[FixedLayer, ...]:
        """Hidden layers and the output layer."""
        return (*self.hidden, self.output)


def commands_rpm(model: VehicleModel) -> bool:
    """Whether all commands of a vehicle model are propeller speeds."""
    return all(signal.unit == "rpm" for signal in model.commands)


def check_policy(policy: Policy) -> None:
    """Check that the format can represent a policy.

    Raises:
        InputError: a vehicle model without C, an activation other than ReLU, a weight or bias that
            is not finite, or a motor command that no ``uint16_t`` rpm can hold.
    """
    if policy.vehicle not in MODELS:
        raise InputError(f"vehicle model {policy.vehicle!r} has no C, supported: {list(MODELS)}")
    if policy.activation != "relu" and len(policy.layers) > 1:
        raise InputError(
            f"layer 0, row 0 and every hidden row: activation {policy.activation!r} is "
            "unsupported in fixed point, allowed: ['relu']"
        )
    for index, (kernel, bias) in enumerate(policy.layers):
        for row in range(kernel.shape[1]):
            values = np.append(kernel[:, row], bias[row])
            bad = values[~np.isfinite(values)]
            if bad.size:
                raise InputError(f"layer {index}, row {row}: {bad[0]} is not a finite weight")
    if commands_rpm(MODELS[policy.vehicle]) and not (
        np.all(policy.command_low >= 0) and np.all(policy.command_high <= 65535)
    ):
        raise InputError(
            f"command range {policy.command_low.tolist()}..{policy.command_high.tolist()} rpm "
            "does not fit in 0..65535"
        )


def convert(policy: Policy, overrides: dict[str, float] | None = None) -> FixedNetwork:
    """The integers of a policy; ``proof.prove`` must pass before they are used.

    Args:
        policy: any number of ReLU layers of any width.
        overrides: declared ranges by input name, powers of two; see ``ranges.declare``.

    Raises:
        InputError: see ``check_policy`` and ``ranges.declare``; or a row whose numbers are too
            large for the format.
    """
    check_policy(policy)
    box = declare(policy, overrides)
    hidden = convert_hidden(policy.layers[:-1], box.ranges)
    return _output_layer(policy, box, hidden)


@dataclasses.dataclass(frozen=True)
class Hidden:
    """The hidden layers as integers, and what the last of them gives."""

    layers: tuple[FixedLayer, ...]
    scale: np.ndarray  # real value of one unit of the outputs
    magnitude: np.ndarray  # largest real output


def convert_hidden(layers: Sequence[tuple[np.ndarray, np.ndarray]], ranges: np.ndarray) -> Hidden:
    """The integers of ReLU layers (kernel, bias) over inputs in +-ranges.

    Raises:
        InputError: a row whose range is not finite.
    """
    low, high, scale = -ranges, ranges, ranges / ONE
    hidden = []
    for index, (kernel, bias) in enumerate(layers):
        layer, high = _hidden_layer(index, _exact(kernel).T, _exact(bias), scale, low, high)
        low, scale = np.zeros_like(high), layer.scale
        hidden.append(layer)
    return Hidden(tuple(hidden), scale, np.maximum(-low, high))


def _exact(values: np.ndarray) -> np.ndarray:
    """Float32 parameters as float64: the numbers that the float policy computes with."""
    return np.asarray(values, np.float32).astype(np.float64)


def _finite(index: int, row: int, value: float) -> float:
    if not math.isfinite(value):
        raise InputError(f"layer {index}, row {row}: its range is not finite, no proof is possible")
    return value


def _hidden_layer(
    index: int,
    weights: np.ndarray,
    bias: np.ndarray,
    scale_in: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[FixedLayer, np.ndarray]:
    """Integers of a hidden layer (rows, columns), and the upper bound of its real outputs."""
    rows, columns = weights.shape
    integers = np.zeros((rows, columns), np.int32)
    biases = np.full(rows, 2 ** (WORD - 1), np.int64)
    scales, upper = np.ones(rows), np.zeros(rows)
    magnitude = np.maximum(-low, high)
    for row in range(rows):
        w, b = weights[row], float(bias[row])
        with np.errstate(over="ignore", invalid="ignore"):
            top = math.fsum([b, *np.where(w > 0, w * high, w * low)])
            total = math.fsum([abs(b), *np.abs(w) * magnitude])
        _finite(index, row, total)
        if top <= 0:
            continue  # never active for any input of the box: a row of zeros is the same function
        scales[row] = scale = _scale(top, total, float(np.max(np.abs(w) * scale_in)), columns)
        integers[row] = np.rint(w * scale_in * (2.0**WORD / scale)).astype(np.int64)
        biases[row] += round(b * (2.0**WORD / scale))
        upper[row] = scale * _upper(
            integers[row], int(biases[row]), low / scale_in, high / scale_in
        )
    return FixedLayer(integers, biases, scales), upper


def _upper(weights: np.ndarray, bias: int, low: np.ndarray, high: np.ndarray) -> int:
    """The largest output of an integer row, exactly, for integer inputs in [low, high]."""
    ends = zip(weights.tolist(), low.tolist(), high.tolist(), strict=True)
    return max(0, (bias + sum(w * round(b if w > 0 else a) for w, a, b in ends)) >> WORD)


def _scale(top: float, total: float, largest: float, columns: int) -> float:
    """The smallest safe scale of a row.

    Args:
        top: upper bound of its real output, which must stay below 2^30.
        total: bound of |bias| + sum |w| |x|, which must stay below 2^63 in the accumulator.
        largest: largest |W_ij| s_j, whose integer must fit in 31 bits.
        columns: how many weights are rounded.
    """
    margin = 1.0 + 2.0**-20  # rounding of the weights, and of this computation
    return max(
        top / (2**30 - HEADROOM - columns),
        margin * total / 2.0 ** (62.999 - WORD),
        margin * largest * 2.0**WORD / LARGEST_WEIGHT,
    )


def _output_layer(policy: Policy, box: InputBox, hidden: Hidden) -> FixedNetwork:
    """The output layer with the command's range folded in, and the whole network."""
    kernel, bias = _exact(policy.layers[-1][0]).T, _exact(policy.layers[-1][1])
    low, high = policy.command_low, policy.command_high
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    fraction_bits = min(30, 30 - math.frexp(float(np.max(np.abs([low, high]))))[1])
    kernel, bias = half[:, None] * kernel, half * bias + middle
    index, limits = len(hidden.layers), []
    for row in range(len(bias)):
        total = math.fsum([abs(bias[row]), *np.abs(kernel[row]) * hidden.magnitude])
        largest = np.max(np.abs(kernel[row]) * hidden.scale)
        _finite(index, row, total)
        limits.append(largest_power(total, largest))
        if limits[-1] <= fraction_bits:
            raise InputError(
                f"layer {index}, row {row}: outputs up to {total:.3g} leave no bits for a "
                "command; the range proof fails"
            )
    power = min(*limits, fraction_bits + LARGEST_SHIFT)
    shift = power - fraction_bits
    weights = np.rint(kernel * hidden.scale * 2.0**power).astype(np.int64).astype(np.int32)
    rounded = [round(float(b) * 2.0**power) + 2 ** (shift - 1) for b in bias]
    return FixedNetwork(
        box=box,
        hidden=hidden.layers,
        output=FixedLayer(
            weights, np.array(rounded, np.int64), np.full(len(bias), 2.0**-fraction_bits)
        ),
        output_shift=shift,
        fraction_bits=fraction_bits,
        command_low=np.rint(low * 2.0**fraction_bits).astype(np.int64),
        command_high=np.rint(high * 2.0**fraction_bits).astype(np.int64),
        model=MODELS[policy.vehicle],
    )


def largest_power(total: float, largest: float) -> int:
    """The largest k with total 2^k below 2^62.9 and largest 2^k below 2^31 - 1."""
    bits = [62.9 - math.log2(total)] if total > 0 else []
    bits += [30.99 - math.log2(largest)] if largest > 0 else []
    return math.floor(min(bits)) if bits else 62
