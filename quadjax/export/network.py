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

LARGEST_HIDDEN = 2**INPUT_BITS - 1
LARGEST_WEIGHT = 2**31 - 1
# Scales leave this many units of headroom, and one per column, for the rounding of weights.
HEADROOM = 257
UNUSED = 2.0**-60  # real value of a unit of an output that is always 0: it limits no later scale
LARGEST_SHIFT = 32  # of the output: its clamp limits stay below 2^63


@dataclasses.dataclass(frozen=True)
class FixedLayer:
    """Integers of one dense layer; row ``i`` is output ``i``."""

    weights: np.ndarray  # (rows, columns) int32
    bias: np.ndarray  # (rows,) int64, rounding half folded in
    scale: np.ndarray  # (rows,) float64, real value of one unit of the output


@dataclasses.dataclass(frozen=True)
class FixedNetwork:
    """A policy as integers: what the emulator runs and the C contains."""

    box: InputBox
    layers: tuple[FixedLayer, ...]  # hidden layers and the output layer
    output_shift: int  # from the output accumulator to its int32
    fraction_bits: int  # of a command: command = integer / 2**fraction_bits
    command_low: np.ndarray  # (outputs,) int64, in units of 2**-fraction_bits
    command_high: np.ndarray  # (outputs,) int64
    model: VehicleModel

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
        return len(self.layers[-1].bias)


def check_policy(policy: Policy) -> None:
    """Check that the format can represent a policy.

    Raises:
        InputError: a vehicle model without C, an activation other than ReLU, a weight or bias that
            is not finite, or a motor command that no ``uint16_t`` rpm can hold.
    """
    if policy.vehicle not in MODELS:
        raise InputError(f"vehicle model {policy.vehicle!r} has no C, supported: {list(MODELS)}")
    if policy.own is not None:
        raise InputError(
            f"the policy's network is {policy.own.module}, allowed: a perceptron, without "
            "network.module"
        )
    if policy.activation != "relu" and len(policy.layers) > 1:
        raise InputError(
            f"layer 0, row 0 and every hidden row: activation {policy.activation!r} is "
            "unsupported in fixed point, allowed: ['relu']"
        )
    for index, (kernel, bias) in enumerate(policy.layers):
        values = np.concatenate([kernel, bias[None]]).T
        for row, column in np.argwhere(~np.isfinite(values)):
            raise InputError(
                f"layer {index}, row {row}: {values[row, column]} is not a finite weight"
            )
    ends = (policy.command_low, policy.command_high)
    rpm = all(signal.unit == "rpm" for signal in MODELS[policy.vehicle].commands)
    if rpm and (np.any(ends[0] < 0) or np.any(ends[1] > 65535)):
        text = "..".join(str(end.tolist()) for end in ends)
        raise InputError(f"command range {text} rpm does not fit in 0..65535")


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
    hidden, scale, magnitude = convert_hidden(policy.layers[:-1], box.ranges)
    low, high = policy.command_low, policy.command_high
    fraction_bits = min(30, 30 - math.frexp(float(np.max(np.abs([low, high]))))[1])
    kernel, bias = output_layer(policy)
    limits = []
    for row in range(len(bias)):
        total, power = largest_power(len(hidden), row, kernel[row], bias[row], scale, magnitude)
        if power <= fraction_bits:
            raise InputError(
                f"layer {len(hidden)}, row {row}: outputs up to {total:.3g} leave no bits for a "
                "command; the range proof fails"
            )
        limits.append(power)
    power = min(*limits, fraction_bits + LARGEST_SHIFT)
    shift = power - fraction_bits
    weights = np.rint(kernel * scale * 2.0**power).astype(np.int64).astype(np.int32)
    rounded = np.array([round(float(b) * 2.0**power) + 2 ** (shift - 1) for b in bias], np.int64)
    output = FixedLayer(weights, rounded, np.full(len(bias), 2.0**-fraction_bits))
    return FixedNetwork(
        box=box,
        layers=(*hidden, output),
        output_shift=shift,
        fraction_bits=fraction_bits,
        command_low=np.rint(low * 2.0**fraction_bits).astype(np.int64),
        command_high=np.rint(high * 2.0**fraction_bits).astype(np.int64),
        model=MODELS[policy.vehicle],
    )


def exact(values: np.ndarray) -> np.ndarray:
    """Float32 parameters as float64: the numbers that the float policy computes with."""
    return np.asarray(values, np.float32).astype(np.float64)


def output_layer(policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Weights (outputs, columns) and bias of the last layer, from action to command folded in."""
    low, high = policy.command_low, policy.command_high
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    kernel, bias = (exact(values) for values in policy.layers[-1])
    return half[:, None] * kernel.T, half * bias + middle


def convert_hidden(
    layers: Sequence[tuple[np.ndarray, np.ndarray]], ranges: np.ndarray
) -> tuple[tuple[FixedLayer, ...], np.ndarray, np.ndarray]:
    """The integers of ReLU layers (kernel, bias) over inputs in +-ranges.

    Returns:
        The layers, the real value of one unit of each output, and the largest real outputs.

    Raises:
        InputError: a row whose range is not finite.
    """
    low, high, scale = -ranges, ranges, ranges / ONE
    hidden = []
    for index, (kernel, bias) in enumerate(layers):
        layer, high = _hidden_layer(index, exact(kernel).T, exact(bias), scale, low, high)
        low, scale = np.zeros_like(high), layer.scale
        hidden.append(layer)
    return tuple(hidden), scale, np.maximum(-low, high)


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
    scales, upper = np.full(rows, UNUSED), np.zeros(rows)
    magnitude = np.maximum(-low, high)
    lowest, highest = ([round(x) for x in (end / scale_in).tolist()] for end in (low, high))
    margin = 1.0 + 2.0**-20  # rounding of the weights, and of this computation
    for row in range(rows):
        w, b = weights[row], float(bias[row])
        with np.errstate(over="ignore", invalid="ignore"):
            top = math.fsum([b, *np.where(w > 0, w * high, w * low)])
            total = math.fsum([abs(b), *np.abs(w) * magnitude])
        _check_finite(index, row, total)
        if top <= 0:
            continue  # never active for any input of the box: a row of zeros is the same function
        scales[row] = scale = max(  # the smallest safe scale: of the output, accumulator, weights
            top / (2**30 - HEADROOM - columns),
            margin * total / 2.0 ** (62.999 - WORD),
            margin * float(np.max(np.abs(w) * scale_in)) * 2.0**WORD / LARGEST_WEIGHT,
        )
        integers[row] = np.rint(w * scale_in * (2.0**WORD / scale)).astype(np.int64)
        biases[row] += round(b * (2.0**WORD / scale))
        ends = zip(integers[row].tolist(), lowest, highest, strict=True)
        accumulated = int(biases[row]) + sum(w * (b if w > 0 else a) for w, a, b in ends)
        upper[row] = scale * max(0, accumulated >> WORD)
    return FixedLayer(integers, biases, scales), upper


def _check_finite(index: int | str, row: int, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"layer {index}, row {row}: its range is not finite, no proof is possible")


def largest_power(
    layer: int | str,
    row: int,
    kernel: np.ndarray,
    bias: float,
    scale: np.ndarray,
    magnitude: np.ndarray,
) -> tuple[float, int]:
    """Scale of a row of an output layer over activations of ``scale`` and ``magnitude``.

    Returns:
        The largest real output, and the largest k with that times 2^k below 2^62.9 and the largest
        weight times 2^k below 2^31 - 1.

    Raises:
        InputError: a row whose range is not finite.
    """
    total = math.fsum([abs(bias), *np.abs(kernel) * magnitude])
    largest = np.max(np.abs(kernel) * scale)
    _check_finite(layer, row, total)
    bits = [62.9 - math.log2(total)] if total > 0 else []
    bits += [30.99 - math.log2(largest)] if largest > 0 else []
    return total, math.floor(min(bits)) if bits else 62
