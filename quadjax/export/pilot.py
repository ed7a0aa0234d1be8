"""Laps of a policy as the exported fixed-point code flies it."""

from collections.abc import Callable

import jax

from quadjax.config.schema import Config
from quadjax.export.emulator_jax import fixed_point_actor
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, Race
from quadjax.race.laps import Laps, Trace


def fly_fixed_point(
    config: Config,
    policy: Policy,
    race: Race,
    trace: bool = False,
    name: str = "policy",
    ranges: dict[str, float] | None = None,
) -> tuple[Laps, Trace | None]:
    """Time the laps of a policy as the exported fixed-point code computes it, bit for bit.

    Like the code on the drone it flies the mean, and what is outside the declared ranges (the
    converter's defaults, or ``ranges``) it sees at their edge. Other arguments and errors as of
    ``quadjax.policy.pilot.fly_policy``.
    """
    commands: Callable[[jax.Array], jax.Array] = fixed_point_actor(policy, ranges)

    def actor(own: Pilot, observation: jax.Array, noise: jax.Array) -> jax.Array:
        given = commands(pilot.see(own, observation))
        return 2.0 * (given - own.low) / (own.high - own.low) - 1.0

    return pilot.fly_by(config, policy, race, actor, True, trace, name)
