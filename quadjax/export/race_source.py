"""The race of a policy: which configuration describes it, and its environment."""

import dataclasses
from pathlib import Path

from quadjax.config.assembly import make_environment, make_params
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.export.names import RESIDUAL_FILE
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, adapt_race, make_pilot
from quadjax.policy.race import differences, own_race
from quadjax.race.environment import Race
from quadjax.race.observation_config import ESTIMATED
from quadjax.race.observations import HIGHEST_RPM
from quadjax.race.types import RaceParams
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
        policy: its observation and scales replace the config's; commands are clipped to the limits
            of the vehicle.
        origin: of the config, for messages.
        name: the policy file, for messages.

    Raises:
        InputError: a config for another vehicle, or an observation that the race lacks.
    """
    residual, whole = config.vehicle.residual and located(config.vehicle.residual), config
    source = "moment_ext" in policy.layout and policy.layout["moment_ext"].source
    if source:
        config = config.at("observation.disturbance", source)
    if HIGHEST_RPM in policy.layout:
        if config.battery is None:
            raise InputError(
                f"{origin}: battery is null, and {name} observes {HIGHEST_RPM}; give the config "
                "that it was trained with (CONFIG or --race CONFIG)"
            )
        config = config.at("observation.highest_rpm", ESTIMATED)  # as on board
    environment, params = make_environment(config), make_params(config)
    try:
        environment, params = adapt_race(environment, params, policy, name)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    params, pilot = params.replace(heading=None), make_pilot(policy, deterministic=True)
    track, vehicle = (Path(p.name or p.file or "").name for p in (config.track, config.vehicle))
    return PolicyRace(environment, params, pilot, track, vehicle, origin, whole, residual or None)


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
            "--allow-other-race accepts it"
        )
    return "the race of the policy file"
