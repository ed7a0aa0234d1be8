"""The fixed-point policy as pure JAX functions, for simulations of the exported C."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.export import emulator
from quadjax.export.fixed import FixedNetwork, convert
from quadjax.export.integers import enable_x64
from quadjax.export.proof import prove
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot
from quadjax.race.laps import Actor


def fixed_point_forward(network: FixedNetwork) -> Callable[[jax.Array], jax.Array]:
    """A function from observations (.., inputs) float32 to commands (.., outputs) int32.

    It can be called under ``jit`` and ``vmap``, and enables 64-bit integers for itself only.
    """

    def forward(observation: jax.Array) -> jax.Array:
        with enable_x64(True):
            return emulator.forward(network, observation, jnp)

    return forward


def fixed_point_actor(
    policy: Policy, ranges: dict[str, float] | None = None
) -> Callable[[jax.Array], jax.Array]:
    """The fixed-point policy as a function from one observation to the commands.

    Args:
        policy: see ``fixed.convert``.
        ranges: declared ranges that differ from the defaults.

    Returns:
        A pure function from an observation (inputs,) float32 to the commands (4,) float32, in rpm,
        or rad/s and m/s^2. Its integers are those of the C, bit for bit; float32 holds a command to
        2^-24 of itself.

    Raises:
        InputError: a policy that cannot be converted or proven.
    """
    network = convert(policy, ranges)
    prove(network, policy)
    integers, scale = fixed_point_forward(network), np.float32(2.0**-network.fraction_bits)
    return lambda observation: integers(observation).astype(jnp.float32) * scale


def fixed_point_fly(policy: Policy, ranges: dict[str, float] | None = None) -> Actor:
    """The actor of ``quadjax.evaluate`` that computes a policy as the exported C does, bit for bit.

    The C computes the mean action and clips observations to the declared ranges. Arguments and
    errors as of ``fixed_point_actor``.
    """
    commands = fixed_point_actor(policy, ranges)

    def act(own: Pilot, observation: jax.Array, _noise: jax.Array) -> jax.Array:
        given = commands(pilot.see(own, observation))
        return 2.0 * (given - own.low) / (own.high - own.low) - 1.0

    return act
