"""A policy file in the race: fitted to the environment it flies in, then timed.

The environment scales actions and observations by its own vehicle's ranges; a policy was trained
with those in its file. Both are converted here, so that a policy commands the rpm (or rates and
thrust) that its file says, whatever the vehicle's own limits are, and sees its propeller speeds and
thrust in the scaling that it was trained with. The race itself scales the disturbances as the file
says, because it may draw none and yet meet some: a steady moment, or less thrust than modelled.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.config.checks import CHOICES
from quadjax.config.schema import Config, DisturbanceConfig
from quadjax.core.errors import InputError
from quadjax.policy.file import ACTION_SIZE, Policy
from quadjax.policy.inference import Flying, act_sampled, flying
from quadjax.race.build import build_params, choices_of, disturbance_range
from quadjax.race.environment import Choices, RaceParams, command
from quadjax.race.laps import Actor, Laps, Trace, fly_laps

Ranges = tuple[np.ndarray, np.ndarray]  # lowest and highest
DISTURBANCES = tuple(DisturbanceConfig().half_widths)
KNOWN = ("wrap_next_yaw", "disturbance_input", "disturbance")  # what a policy says of its scaling


@struct.dataclass
class Pilot:
    """A policy and the conversions between its scaling and the environment's."""

    policy: Flying
    see_scale: jax.Array  # (observations,)
    see_offset: jax.Array  # (observations,)
    act_scale: jax.Array  # (4,)
    act_offset: jax.Array  # (4,)
    low: jax.Array  # (4,) lowest command of the environment's vehicle: rpm, or rad/s and m/s^2
    high: jax.Array  # (4,)
    noise: jax.Array  # () 1 to fly samples, 0 to fly the mean: one compilation for both


@dataclasses.dataclass(frozen=True)
class Race:
    """What is flown and how.

    Attributes:
        laps: how many.
        runs: how many drones, each by itself.
        from_hover: start at hover in the last gate, else from the training's random starts.
        seed: of the noise, the disturbances and the starts.
    """

    laps: int = 6
    runs: int = 5
    from_hover: bool = True
    seed: int = 0


def check_fits(config: Config, policy: Policy, name: str) -> None:
    """Raise an ``InputError`` for a policy that cannot fly this vehicle as it was trained.

    Args:
        config: of the race.
        policy: the policy file's content.
        name: the file, for the message.
    """
    if policy.vehicle != config.vehicle.kind:
        raise InputError(
            f"{name}: a policy for the {policy.vehicle} vehicle; the config's vehicle.kind is "
            f"{config.vehicle.kind}"
        )
    seen = policy.observation
    if not isinstance(seen, dict):
        raise InputError(f"{name}: meta 'observation' is {seen!r}, expected a mapping")
    if not isinstance(seen.get("wrap_next_yaw", True), bool):
        raise InputError(
            f"{name}: meta observation.wrap_next_yaw is {seen['wrap_next_yaw']!r}, allowed: "
            "true, false"
        )
    allowed = CHOICES["episode.disturbance_input"]
    if seen.get("disturbance_input", "true") not in allowed:
        raise InputError(
            f"{name}: meta observation.disturbance_input is {seen['disturbance_input']!r}, "
            f"allowed: {', '.join(allowed)}"
        )
    _policy_disturbance(policy, dict.fromkeys(DISTURBANCES, 0.0), name)


def unknown_scaling(policy: Policy) -> list[str]:
    """Keys of a policy's ``observation`` that mean nothing here."""
    return [key for key in policy.observation if key not in KNOWN]


def _policy_disturbance(policy: Policy, default: dict[str, float], name: str) -> dict[str, float]:
    """Half-widths by which a policy's disturbances were scaled, or ``default``."""
    widths = policy.observation.get("disturbance")
    if widths is None:
        return default
    fine = isinstance(widths, dict) and set(widths) <= set(DISTURBANCES)
    for value in widths.values() if fine else ():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        fine = fine and number and np.isfinite(value) and value >= 0
    if not fine:
        raise InputError(
            f"{name}: meta observation.disturbance is {widths!r}, expected half-widths, not "
            f"negative, of {', '.join(DISTURBANCES)}"
        )
    return default | {key: float(value) for key, value in widths.items()}


def race_of(config: Config, policy: Policy) -> tuple[Choices, RaceParams]:
    """The race of a config, seen as the policy knows it.

    The next gate's yaw is wrapped or not, and the disturbances are scaled, as its file says: also
    where the race draws none, or others. Where the disturbance comes from (true, estimated or none)
    is the race's choice, not the policy's: it is what a drone can measure.
    """
    seen = policy.observation
    episode = dataclasses.replace(
        config.episode,
        **{key: seen[key] for key in ("wrap_next_yaw",) if key in seen},
    )
    config = dataclasses.replace(config, episode=episode)
    drawn = config.disturbance
    trained = _policy_disturbance(policy, drawn.half_widths, "policy")
    scaling = disturbance_range(dataclasses.replace(drawn, **trained))
    return choices_of(config), build_params(config).replace(disturbance_scale=scaling)


def command_ranges(choices: Choices, params: RaceParams) -> Ranges:
    """Lowest and highest command (4,) of the environment's vehicle: rpm, or rad/s and m/s^2."""
    ends = [command(choices, params, jnp.full(ACTION_SIZE, end)) for end in (-1.0, 1.0)]
    low, high = (np.array([float(x) for x in jax.tree.leaves(end)]) for end in ends)
    return low, high


def make_pilot(
    config: Config,
    policy: Policy,
    vehicle: Ranges,
    deterministic: bool,
    name: str = "policy",
) -> Pilot:
    """The policy with the conversions to and from the environment's scaling.

    Args:
        config: of the race.
        policy: the policy file's content.
        vehicle: the environment's lowest and highest command, (4,) each.
        deterministic: fly the mean rather than samples.
        name: the file, for messages.
    """
    check_fits(config, policy, name)
    # Rounded as the environment's numbers are: equal ranges convert by exactly one and zero.
    own = [np.float32(x).astype(np.float64) for x in (policy.command_low, policy.command_high)]
    act_scale, act_offset = _between(own, vehicle)
    choices = choices_of(config)
    see_scale, see_offset = np.ones(choices.layout.size), np.zeros(choices.layout.size)
    actuators = choices.layout.slice(choices.model.actuators.name)
    count = actuators.stop - actuators.start
    back_scale, back_offset = _between(vehicle, own)
    see_scale[actuators] = back_scale[-count:]
    see_offset[actuators] = back_offset[-count:]
    numbers = (see_scale, see_offset, act_scale, act_offset, *vehicle, float(not deterministic))
    return Pilot(flying(policy), *(jnp.asarray(x, jnp.float32) for x in numbers))


def _between(source: Ranges, target: Ranges) -> Ranges:
    """Scale and offset from numbers in [-1, 1] over one range to those over another."""
    (low, high), (to_low, to_high) = source, target
    scale = (high - low) / (to_high - to_low)
    return scale, (high + low - to_high - to_low) / (to_high - to_low)


def see(pilot: Pilot, observation: jax.Array) -> jax.Array:
    """The environment's observation (k,) in the scaling that the policy was trained with."""
    return observation * pilot.see_scale + pilot.see_offset


def fly(pilot: Pilot, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The environment's action (4,) for what it shows, with normal ``noise`` (4,)."""
    action = act_sampled(pilot.policy, see(pilot, observation), pilot.noise * noise)
    return jnp.clip(action, -1.0, 1.0) * pilot.act_scale + pilot.act_offset


def fly_policy(
    config: Config,
    policy: Policy,
    race: Race,
    deterministic: bool,
    trace: bool = False,
    name: str = "policy",
) -> tuple[Laps, Trace | None]:
    """Time a policy file's laps.

    Args:
        config: of the race; the observation is made as the policy's file says.
        policy: the policy file's content.
        race: laps, runs and starts.
        deterministic: fly the mean rather than samples.
        trace: whether to keep what was flown.
        name: the file, for messages.

    Raises:
        InputError: the policy does not fit the vehicle.
    """
    return fly_by(config, policy, race, fly, deterministic, trace, name)


def fly_by(
    config: Config,
    policy: Policy,
    race: Race,
    actor: Actor,
    deterministic: bool,
    trace: bool,
    name: str,
) -> tuple[Laps, Trace | None]:
    """Time the laps of a policy file whose commands ``actor`` computes, as ``fly`` does.

    Other arguments, results and errors as of ``fly_policy``.
    """
    check_fits(config, policy, name)
    choices, params = race_of(config, policy)
    vehicle = command_ranges(choices, params)
    pilot = make_pilot(config, policy, vehicle, deterministic, name)
    key = jax.random.key(race.seed)
    return fly_laps(
        choices, params, actor, pilot, key, race.laps, race.runs, race.from_hover, trace
    )
