"""The race of a policy: which configuration describes it, and its environment."""

import contextlib
import dataclasses
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from quadjax.config import race as build
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.resources import CONFIGS
from quadjax.policy.file import Policy
from quadjax.race.environment import Choices, RaceParams
from quadjax.race.layout import NEXT_YAW, arranged
from quadjax.vehicle.residual_file import located

DEFAULT_CONFIG, DEFAULT = CONFIGS / "e2e_shac.yaml", "default"
STARTS = "start.heading=north"  # with any yaw: the same flights, and self-tests, for every preset
CONFIG_FILE = "config.yaml"  # of a training run or an exported folder


@dataclasses.dataclass(frozen=True)
class OwnRace:
    """The environment that a policy was trained in."""

    choices: Choices
    params: RaceParams
    config: Config
    origin: str  # where the configuration came from, for messages

    @property
    def time_step(self) -> float:
        """Time step of the simulation, s."""
        return float(self.params.limits.time_step)


def own_race(
    policy: Policy,
    file: Path | None = None,
    config: Path | str | Config | None = None,
    track: str | None = None,
    residual: Path | None = None,
) -> OwnRace:
    """The race that a policy was trained in, observed as the policy was trained to see it.

    The configuration is the first of: ``config``; the one in the policy file; ``config.yaml`` next
    to the policy file; the default race, with the residual that the policy file names.

    Args:
        policy: the scaling of its observation and the limits of its commands replace the config's.
        file: the policy file.
        config: a configuration or the path of one.
        track: a track file that replaces the config's, or ``None``.
        residual: a residual file that replaces the config's, if the config names one.

    Raises:
        InputError: a file that cannot be read, a config for another vehicle, a scaling that makes
            no sense, or limits that no vehicle of the policy's kind has.
    """
    found, origin = _configuration(policy, file, config)
    overrides = [*_limits(policy), *_observation(policy), STARTS]
    if track is not None:
        overrides.append(f"track={track}")
    with _as_file(found) as path:
        if origin == DEFAULT:
            overrides += _default_vehicle(policy)
        else:
            _check_vehicle(policy, load_config(path), origin)
        loaded = load_config(path, overrides)
        if residual is not None and loaded.vehicle.residual:
            loaded = load_config(path, [*overrides, f"vehicle.residual={residual}"])
    choices = build.choices_of(loaded)
    layout = arranged(choices.layout, policy.layout, file.name if file else "the policy")
    choices = dataclasses.replace(choices, layout=layout)
    return OwnRace(choices, build.build_params(loaded), loaded, origin)


def _configuration(
    policy: Policy, file: Path | None, config: Path | str | Config | None
) -> tuple[Path | Config | dict[str, Any], str]:
    """The configuration of a policy's race, and its origin."""
    if config is not None:
        return (config, "config") if isinstance(config, Config) else (Path(config), str(config))
    if policy.config is not None:
        return policy.config, "the policy file's config"
    if file is not None and (file.parent / CONFIG_FILE).is_file():
        return file.parent / CONFIG_FILE, str(file.parent / CONFIG_FILE)
    return DEFAULT_CONFIG, DEFAULT


@contextlib.contextmanager
def _as_file(config: Path | Config | dict[str, Any]) -> Iterator[Path]:
    if isinstance(config, Path):
        yield config
        return
    with tempfile.TemporaryDirectory() as folder:
        text = json.dumps(config) if isinstance(config, dict) else config.to_yaml()  # JSON is YAML
        write_text(Path(folder) / CONFIG_FILE, text)
        yield Path(folder) / CONFIG_FILE


def _default_vehicle(policy: Policy) -> list[str]:
    """Overrides for the policy's vehicle, with the residual that its file names."""
    overrides, named = [f"vehicle.model={policy.vehicle}"], policy.source.get("residual")
    if isinstance(named, str) and policy.vehicle == "motor" and located(named).is_file():
        overrides.append(f"vehicle.residual={named}")
    return overrides


def _check_vehicle(policy: Policy, config: Config, origin: str) -> None:
    if config.vehicle.model != policy.vehicle:
        raise InputError(
            f"{origin}: vehicle.model is {config.vehicle.model}, but the policy commands the "
            f"{policy.vehicle} vehicle"
        )


def _limits(policy: Policy) -> list[str]:
    """Overrides for a vehicle whose commands have the policy's limits."""
    low, high = policy.command_low.tolist(), policy.command_high.tolist()
    if policy.vehicle == "motor":
        if len(set(low)) > 1 or len(set(high)) > 1:
            raise InputError(f"policy commands {low}..{high} rpm: expected the same for all motors")
        return [f"vehicle.constants.rpm_min={low[0]!r}", f"vehicle.constants.rpm_max={high[0]!r}"]
    if low[:3] != [-x for x in high[:3]]:
        raise InputError(f"policy commands rates of {low[:3]}..{high[:3]} rad/s: expected +-")
    names = ("p_max", "q_max", "r_max", "thrust_max", "thrust_min")
    values = zip(names, [*high, low[3]], strict=True)
    return [f"vehicle.constants.{name}={value!r}" for name, value in values]


def _observation(policy: Policy) -> list[str]:
    """Overrides for the scaling that the policy was trained with."""
    overrides = [f"disturbance.{name}={x!r}" for name, x in policy.disturbance_widths.items()]
    overrides.append(f"observation.wrap_next_yaw={str(NEXT_YAW.name in policy.layout).lower()}")
    source = "moment_ext" in policy.layout and policy.layout["moment_ext"].source
    if source:
        overrides.append(f"observation.disturbance={source}")
    return overrides
