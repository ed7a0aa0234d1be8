"""The race of a policy: which configuration describes it, and its environment."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import make_environment, make_params
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.export.names import RESIDUAL_FILE
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, fit_race, make_pilot
from quadjax.policy.race import differences, own_race
from quadjax.race.environment import Race
from quadjax.race.observation_config import ESTIMATED
from quadjax.race.observations import HIGHEST_RPM
from quadjax.race.types import RaceParams
from quadjax.vehicle.protocol import Constants, VehicleModel
from quadjax.vehicle.residual import located


@dataclasses.dataclass(frozen=True)
class PolicyRace:
    """The environment that a policy was trained in, and the policy in it."""

    environment: Race
    params: RaceParams
    pilot: Pilot  # its mean actions
    track: str
    vehicle: str
    origin: str  # where the configuration came from, for messages
    config: Config
    residual: Path | None  # the file of the residual

    @property
    def text(self) -> str:
        """The configuration as YAML, with its residual in RESIDUAL_FILE."""
        whole = self.config
        return (whole.at("vehicle.residual", RESIDUAL_FILE) if self.residual else whole).to_yaml()

    @property
    def time_step(self) -> float:
        """Time step of the simulation, s."""
        return float(self.params.rules.time_step)


def policy_race(config: Config, policy: Policy, origin: str, name: str = "policy") -> PolicyRace:
    """The race of a configuration, with the observation and command range of a policy.

    Start headings are drawn around north, so that the flights are the same for every preset.

    Args:
        config: of the race.
        policy: its observation and the limits of its commands replace the config's.
        origin: of the config, for messages.
        name: the policy file, for messages.

    Raises:
        InputError: a config for another vehicle, an observation that the race lacks, or command
            limits that the vehicle model cannot have.
    """
    residual, whole = config.vehicle.residual and located(config.vehicle.residual), config
    source = "moment_ext" in policy.layout and policy.layout["moment_ext"].source
    if source:
        config = config.at("observation.disturbance", source)
    if HIGHEST_RPM in policy.layout:
        if config.battery is None:
            raise InputError(
                f"{origin}: battery is null, and {name} observes {HIGHEST_RPM}; give the config "
                "that it was trained with (config=CONFIG)"
            )
        config = config.at("observation.highest_rpm", ESTIMATED)  # as on board
    environment, params = make_environment(config), make_params(config)
    try:
        environment, params = fit_race(environment, params, policy, name)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    constants = _with_limits(environment.model, params.vehicle.constants, policy)
    params = params.replace(vehicle=params.vehicle.replace(constants=constants), heading=None)
    pilot = make_pilot(environment, params, policy, deterministic=True)
    track, vehicle = (Path(p.name or p.file or "").name for p in (config.track, config.vehicle))
    return PolicyRace(environment, params, pilot, track, vehicle, origin, whole, residual or None)


def _with_limits(model: VehicleModel, constants: Constants, policy: Policy) -> Constants:
    """Constants whose command range is the policy's; the range is linear in the limits."""
    names = model.groups["limits"]

    def command_range(values: jax.Array) -> jax.Array:
        limited = constants.replace(**dict(zip(names, values, strict=True)))
        return jnp.stack([jnp.asarray(x) for x in jax.tree.leaves(model.command_range(limited))])

    wanted = np.concatenate([policy.command_low, policy.command_high])
    ends = (jax.tree.leaves(end) for end in model.command_range(constants))
    if np.allclose(np.concatenate([np.asarray(x) for x in ends]), wanted, rtol=1e-6, atol=1e-9):
        return constants
    matrix = np.asarray(jax.jacobian(command_range)(jnp.ones(len(names))), np.float64)
    values = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    if not np.allclose(matrix @ values, wanted, rtol=1e-6, atol=1e-9):
        raise InputError(
            f"the policy commands {policy.command_low.tolist()}..{policy.command_high.tolist()}: "
            f"no {model.name} vehicle has these limits, which follow from {', '.join(names)}"
        )
    return constants.replace(
        **{name: jnp.float32(x) for name, x in zip(names, values, strict=True)}
    )


def check_race(policy: Policy, race: PolicyRace, file: Path) -> str:
    """Check that a race is the one in the policy's file, if it has one.

    Vehicle, residual, track, rules and battery are compared.

    Returns:
        The properties that were compared, as text for a report.

    Raises:
        InputError: the first difference.
    """
    own = own_race(policy, race.config, file.name)
    if own is None:
        return "the policy file has no config"
    if difference := next(differences(own, race.config), None):
        raise InputError(
            f"{file.name}: trained in another race than {race.origin}: {difference}; "
            "allow_other_race=True accepts it"
        )
    return "vehicle, track, rules and battery are those of the policy file"
