"""The network of the exported C in NumPy and in JAX, integer for integer."""

from collections.abc import Callable
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.export.integers import ONE, Array, dense, digest, hidden_output, quantize
from quadjax.export.network import FixedNetwork, convert
from quadjax.export.proof import prove
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot
from quadjax.race.laps import Actor

CHUNK = 10_000  # rows of which all accumulators are in memory at once


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
