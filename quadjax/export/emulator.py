"""The exported C in NumPy, integer for integer: the network, the observation and the gates.

The network is also computed in JAX, for simulations of the exported C.
"""

from collections.abc import Callable
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.export.integers import (
    INPUT_BITS,
    ONE,
    Array,
    bit_mask,
    dense,
    digest,
    hidden_output,
    quantize,
    round_shift,
    status_masks,
)
from quadjax.export.network import FixedNetwork, convert
from quadjax.export.proof import prove
from quadjax.export.race_tables import (
    QUATERNION_EXPONENT,
    TURN_BITS,
    TURNS_PER_UNIT,
    TWO_PI,
    YAW_EXPONENT,
    Input,
    RaceTables,
)
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot
from quadjax.race.laps import Actor

NO_EVENT, PASSED, MISSED = 0, 1, 2
CHUNK = 10_000  # rows of which all accumulators are in memory at once

# ---- network -------------------------------------------------------------------------------------


def forward_traced(
    network: FixedNetwork, q: Array, xp: ModuleType = np
) -> tuple[Array, list[Array]]:
    """Commands (.., outputs) int32 of integer inputs, and all accumulators (.., rows) of layers.

    A command is in units of 2^-fraction_bits.
    """
    y = xp.clip(xp.asarray(q, xp.int64), -ONE, ONE)
    trace = []
    for layer in network.layers:
        trace.append(dense(y, layer.weights, layer.bias, xp))
        y = hidden_output(trace[-1], xp)
    shift = network.output_shift
    low, high = network.command_low << shift, network.command_high << shift
    return (xp.clip(trace[-1], low, high) >> shift).astype(xp.int32), trace


def forward(network: FixedNetwork, observations: Array, xp: ModuleType = np) -> Array:
    """Commands (.., outputs) int32 of float observations (.., inputs)."""
    return forward_traced(network, quantize(observations, network.box.exponents, xp), xp)[0]


def commands(network: FixedNetwork, observations: np.ndarray) -> np.ndarray:
    """Commands (n, outputs) float64, in rpm, or rad/s and m/s^2."""
    return forward(network, observations) / 2.0**network.fraction_bits


def forward_rows(network: FixedNetwork, q: np.ndarray) -> np.ndarray:
    """Rows (n, outputs + 1) int32 of integer inputs: commands, and the digest of accumulators.

    The digest takes every accumulator, low word before high word, layer after layer.
    """
    rows = [np.zeros((0, network.outputs + 1), np.int32)]
    for start in range(0, len(q), CHUNK):
        values, trace = forward_traced(network, q[start : start + CHUNK])
        traced = digest(np.concatenate(trace, axis=1)).view(np.int32)
        rows.append(np.column_stack([values, traced]))
    return np.concatenate(rows)


def fixed_point_actor(
    policy: Policy, ranges: dict[str, float] | None = None
) -> Callable[[jax.Array], jax.Array]:
    """The fixed-point policy as a function from one observation to the commands.

    Args:
        policy: see ``network.convert``.
        ranges: declared ranges that differ from the defaults.

    Returns:
        A pure function from an observation (inputs,) float32 to the commands (4,) float32, in rpm,
        or rad/s and m/s^2. Its integers are those of the C, bit for bit; float32 holds a command to
        2^-24 of itself. It enables 64-bit integers for itself only.

    Raises:
        InputError: a policy that cannot be converted or proven.
    """
    network = convert(policy, ranges)
    prove(network, policy)
    scale = np.float32(2.0**-network.fraction_bits)

    def act(observation: jax.Array) -> jax.Array:
        with jax.enable_x64(True):
            integers = forward(network, observation, jnp)
        return integers.astype(jnp.float32) * scale

    return act


def fixed_point_fly(policy: Policy, ranges: dict[str, float] | None = None) -> Actor:
    """The actor of ``quadjax.evaluate`` that computes a policy as the exported C does, bit for bit.

    The C computes the mean action and clips observations to the declared ranges. Arguments and
    errors as of ``fixed_point_actor``.
    """
    actor = fixed_point_actor(policy, ranges)
    low, high = (np.asarray(x, np.float32) for x in (policy.command_low, policy.command_high))

    def act(_pilot: Pilot, observation: jax.Array, _noise: jax.Array) -> jax.Array:
        return 2.0 * (actor(observation) - low) / (high - low) - 1.0

    return act


# ---- observation ---------------------------------------------------------------------------------


def observe(
    tables: RaceTables, states: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Network inputs of states (n, state_size) float32 towards gates ``target`` (n,).

    Returns:
        The inputs (n, inputs) int32; and masks (n, 3) uint32: which numbers of the state are
        clipped, which are NaN, and which inputs are outside their range.
    """
    q, gates = quantize(states, tables.exponents), np.asarray(target)
    raw = np.concatenate([_input(tables, part, q, gates) for part in tables.inputs], axis=1)
    clipped = np.clip(raw, -ONE, ONE)
    masks = (*status_masks(states, tables.exponents), bit_mask(clipped != raw))
    return clipped.astype(np.int32), np.stack(masks, axis=1)


def _input(tables: RaceTables, part: Input, q: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The inputs (n, size) of one field, before clipping."""
    if part.kind == "gate":
        return tables.next_gate[target][:, part.sources]
    values, network = q[:, part.sources], tables.box.exponent[part.name]
    gates = tables.track[target]
    if part.kind == "scaled":
        middle, factor, bits = (part.numbers[name] for name in ("middle", "factor", "shift"))
        return ((values - middle) * factor + (np.int64(1) << (bits - 1))) >> bits
    if part.kind == "attitude":
        yaw = (values[:, 2] << YAW_EXPONENT) - gates["yaw"]
        return np.column_stack([values[:, :2], round_shift(wrap(yaw), network)])
    if part.kind == "copy":
        return values
    if part.kind == "rotation":
        vectors, shift = axes_of(values), INPUT_BITS + network
    else:
        if part.kind == "position":
            values = values - gates["position"]
        vectors, shift = [values], INPUT_BITS - tables.fields[part.kind][0] + network
    columns = [x for vector in vectors for x in _rotate(vector, gates["cosine"], gates["sine"])]
    return np.stack([round_shift(x, shift) for x in columns], axis=1)


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
    x, y, z = vector.T
    return [cosine * x + sine * y, cosine * y - sine * x, z << INPUT_BITS]


def wrap(yaw: np.ndarray) -> np.ndarray:
    """A yaw in Q30 within half a turn, by one multiplication."""
    turns = ((yaw >> YAW_EXPONENT) * TURNS_PER_UNIT + (1 << (TURN_BITS - 1))) >> TURN_BITS
    return yaw - turns * TWO_PI


# ---- gates ---------------------------------------------------------------------------------------


def gate_event(
    tables: RaceTables, before: np.ndarray, after: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """The event (n,) of steps from positions ``before`` to ``after`` (n, 3), integers."""
    gates = tables.track[target]
    old, new = (position - gates["position"] for position in (before, after))
    axes = gates["axes"].reshape(-1, 3, 3)  # Q30
    was, now = (np.einsum("nij,nj->in", axes, vector) for vector in (old, new))
    width, height = gates["half_width"], gates["half_height"]
    if tables.world_box:
        aside = np.maximum(np.abs(new[:, 0]), np.abs(new[:, 1]))
        inside = (aside < width) & (np.abs(new[:, 2]) < height)
    else:
        right, down = (np.abs(round_shift(x, INPUT_BITS)) for x in now[1:])
        inside = (right <= width) & (down <= height)
        right, down = (np.minimum(x, width) for x in (right, down))
        inside &= (right * right + down * down <= width * width) | (gates["round"] == 0)
    crossed = (was[0] < 0) & (now[0] >= 0)
    return np.where(crossed, np.where(inside, PASSED, MISSED), NO_EVENT)
