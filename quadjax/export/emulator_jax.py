"""The fixed-point policy in JAX: the same integers whatever the x64 flag, batched by ``vmap``.

JAX has no int64 without that flag, so a product of 31-bit numbers is taken apart: every number
into four limbs of eight bits (-128..127), whose products sum exactly in float32 as long as they
stay below 2^24. All products that share a power of 256 are one column of one matrix product, and
the columns are carried into a pair of 32-bit words.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.export.fixed import (
    TANH_FRACTION_BITS,
    TANH_LIMIT,
    FixedLayer,
    FixedNetwork,
    convert,
)
from quadjax.export.proof import prove
from quadjax.export.squash import (
    SEGMENT_BITS,
    SEGMENTS_PER_UNIT,
    UNITS,
    VALUE_BITS,
    coefficients,
)
from quadjax.policy.file import Policy

LIMBS = 4
COLUMNS = 2 * LIMBS - 1
# 256 inputs x 4 limbs x 128 x 128 = 2^24: the largest block whose sums float32 holds exactly.
BLOCK = 256

Wide = tuple[jax.Array, jax.Array]  # a 64-bit integer: (high int32, low uint32)


def fixed_point_actor(
    policy: Policy, ranges: dict[str, float] | None = None
) -> Callable[[jax.Array], jax.Array]:
    """The fixed-point policy as a function of one observation, for a simulator.

    Args:
        policy: see ``fixed.convert``.
        ranges: declared ranges that differ from the defaults.

    Returns:
        A pure function from an observation (inputs,) float32 to the commands (4,) float32, in rpm,
        or rad/s and m/s^2, to be called under ``jit`` and ``vmap``. Its integers are those of the
        C, bit for bit; float32 holds a command to 2^-24 of itself.

    Raises:
        InputError: a policy that cannot be converted or proven.
    """
    network = convert(policy, ranges)
    prove(network, policy)
    integers = fixed_point_forward(network)
    scale = np.float32(2.0**-network.fraction_bits)

    def commands(observation: jax.Array) -> jax.Array:
        return integers(observation).astype(jnp.float32) * scale

    return commands


def fixed_point_action(
    network: FixedNetwork,
) -> Callable[[object, jax.Array, jax.Array], jax.Array]:
    """The fixed-point policy as an actor for ``evaluate.laps.fly_laps``.

    Returns:
        A function of (anything, observation (inputs,), noise) to the action (4,) in [-1, 1] that
        stands for the command, to float32's precision. The noise is not used: what flies on board
        is the mean.
    """
    integers = fixed_point_forward(network)
    low, high = network.command_low, network.command_high
    middle, span = jnp.asarray(low + high, jnp.int32), np.float32(1.0) / (high - low)

    def act(_policy: object, observation: jax.Array, _noise: jax.Array) -> jax.Array:
        doubled = 2 * integers(observation) - middle
        return doubled.astype(jnp.float32) * span.astype(np.float32)

    return act


def fixed_point_forward(network: FixedNetwork) -> Callable[[jax.Array], jax.Array]:
    """A function from one observation (inputs,) float32 to commands (outputs,) int32."""
    exponents = jnp.asarray(network.box.exponents, jnp.int32)
    layers = [(_limb_matrix(layer), _wide_constant(layer.bias)) for layer in network.layers]

    def forward(observation: jax.Array) -> jax.Array:
        y = quantize(observation, exponents)
        for matrices, bias in layers[:-1]:
            high, _ = _accumulate(y, matrices, bias)
            y = jnp.maximum(high, 0)
        return _output_command(network, _accumulate(y, *layers[-1]))

    return forward


def quantize(observation: jax.Array, exponents: jax.Array) -> jax.Array:
    """Inputs (inputs,) float32 as integers, by their bits: see ``emulator.quantize``."""
    bits = jax.lax.bitcast_convert_type(observation.astype(jnp.float32), jnp.int32)
    magnitude = bits & 0x7FFFFFFF
    limit = (127 + exponents) << 23
    nan = magnitude > 0x7F800000
    magnitude = jnp.minimum(magnitude, limit)
    exponent = magnitude >> 23
    significand = jnp.where(exponent > 0, (magnitude & 0x7FFFFF) | 0x800000, 0)
    shift = exponent - 120 - exponents  # value 2^30 / range = significand 2^shift
    left = significand << jnp.maximum(shift, 0)
    value = left >> jnp.minimum(jnp.maximum(-shift, 0), 31)
    return jnp.where(nan, 0, jnp.where(bits < 0, -value, value))


def _limbs(values: np.ndarray) -> np.ndarray:
    """Balanced base-256 digits (limbs, ...) of integers, float32."""
    rest = np.asarray(values, np.int64)
    digits = []
    for _ in range(LIMBS - 1):
        digit = ((rest + 128) & 255) - 128
        digits.append(digit)
        rest = (rest - digit) >> 8
    return np.stack([*digits, rest]).astype(np.float32)


def _limb_matrix(layer: FixedLayer) -> list[np.ndarray]:
    """Weights as matrices (4 inputs, 7 rows), one per block of inputs."""
    rows, columns = layer.weights.shape
    limbs = _limbs(layer.weights.T)  # (limbs, columns, rows)
    matrices = []
    for start in range(0, columns, BLOCK):
        part = limbs[:, start : start + BLOCK]
        matrix = np.zeros((LIMBS, part.shape[1], COLUMNS, rows), np.float32)
        for i in range(LIMBS):
            for j in range(LIMBS):
                matrix[i, :, i + j] = part[j]
        matrices.append(matrix.reshape(LIMBS * part.shape[1], COLUMNS * rows))
    return matrices


def _wide_constant(values: np.ndarray) -> Wide:
    values = np.asarray(values, np.int64)
    low = (values & 0xFFFFFFFF).astype(np.uint32)
    return jnp.asarray((values >> 32).astype(np.int32)), jnp.asarray(low)


def _accumulate(y: jax.Array, matrices: list[np.ndarray], bias: Wide) -> Wide:
    """``bias + weights @ y`` in 64 bits."""
    rows = bias[0].shape[0]
    columns = jnp.zeros((COLUMNS, rows), jnp.int32)
    for block, matrix in enumerate(matrices):
        part = y[block * BLOCK : (block + 1) * BLOCK]
        digits, rest = [], part
        for _ in range(LIMBS - 1):
            digit = ((rest + 128) & 255) - 128
            digits.append(digit)
            rest = (rest - digit) >> 8
        vector = jnp.concatenate([*digits, rest]).astype(jnp.float32)
        product = jnp.dot(vector, matrix, precision=jax.lax.Precision.HIGHEST)
        columns = columns + product.astype(jnp.int32).reshape(COLUMNS, rows)
    total = bias
    for power in range(COLUMNS):
        total = _add(total, _shift_left(_widen(columns[power]), 8 * power))
    return total


def _widen(value: jax.Array) -> Wide:
    return value >> 31, value.astype(jnp.uint32)


def _add(a: Wide, b: Wide) -> Wide:
    low = a[1] + b[1]
    return a[0] + b[0] + (low < b[1]).astype(jnp.int32), low


def _shift_left(a: Wide, bits: int) -> Wide:
    if bits == 0:
        return a
    if bits >= 32:
        return (a[1] << (bits - 32)).astype(jnp.int32), jnp.zeros_like(a[1])
    return (a[0] << bits) | (a[1] >> (32 - bits)).astype(jnp.int32), a[1] << bits


def _shift_right(a: Wide, bits: int) -> jax.Array:
    """``a >> bits``, arithmetic, of a value whose result fits in 32 bits."""
    if bits >= 32:
        return a[0] >> min(bits - 32, 31)
    if bits == 0:
        return a[1].astype(jnp.int32)
    return (a[0] << (32 - bits)) | (a[1] >> bits).astype(jnp.int32)


def _less(a: Wide, b: Wide) -> jax.Array:
    return (a[0] < b[0]) | ((a[0] == b[0]) & (a[1] < b[1]))


def _clamp(a: Wide, low: np.ndarray, high: np.ndarray) -> Wide:
    """``a`` within [low, high], int64 constants."""
    bottom, top = _wide_constant(low), _wide_constant(high)
    below, above = _less(a, bottom), _less(top, a)
    return tuple(
        jnp.where(below, lo, jnp.where(above, hi, value))
        for value, lo, hi in zip(a, bottom, top, strict=True)
    )


def _multiply(a: jax.Array, b: jax.Array) -> Wide:
    """The product of two int32 in 64 bits, from 16-bit halves."""
    a_high, b_high = a >> 16, b >> 16
    a_low, b_low = (x.astype(jnp.uint32) & 0xFFFF for x in (a, b))
    total = (a_high * b_high, a_low * b_low)
    for high, low in ((a_high, b_low), (b_high, a_low)):
        # A signed 16-bit by an unsigned 16-bit number fits in 32 bits.
        total = _add(total, _shift_left(_widen(high * low.astype(jnp.int32)), 16))
    return total


def _output_command(network: FixedNetwork, sums: Wide) -> jax.Array:
    """Output accumulators as commands (outputs,) int32: see ``emulator.output_command``."""
    shift = network.output_shift
    low, high = network.command_low, network.command_high
    if network.squash == "clip":
        return _shift_right(_clamp(sums, low << shift, high << shift), shift)
    limit = np.full(network.outputs, TANH_LIMIT << (TANH_FRACTION_BITS + shift), np.int64)
    action = _tanh(_shift_right(_clamp(sums, -limit, limit), shift))
    span = jnp.asarray((high - low).astype(np.int32))
    middle = _wide_constant(((high + low) << VALUE_BITS) + (1 << VALUE_BITS))
    doubled = _add(_multiply(action, span), middle)
    return jnp.clip(
        _shift_right(doubled, VALUE_BITS + 1), low.astype(np.int32), high.astype(np.int32)
    )


def _tanh(z: jax.Array) -> jax.Array:
    """See ``squash.tanh_q``."""
    table = jnp.asarray(coefficients())
    magnitude = jnp.minimum(jnp.abs(z), (UNITS * SEGMENTS_PER_UNIT << SEGMENT_BITS) - 1)
    row = table[magnitude >> SEGMENT_BITS]
    place = magnitude & ((1 << SEGMENT_BITS) - 1)
    value = row[..., 3]
    for power in (2, 1, 0):
        value = row[..., power] + _shift_right(_multiply(value, place), SEGMENT_BITS)
    value = jnp.clip(value, 0, 1 << VALUE_BITS)
    return jnp.where(z < 0, -value, value)
