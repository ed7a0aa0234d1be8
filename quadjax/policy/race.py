"""The race of a policy file: the config that every command flies it in."""

import re
from collections.abc import Callable
from pathlib import Path

from quadjax.config.loading import load_config, stored_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, preset_names
from quadjax.core.yaml_files import override
from quadjax.policy.file import Policy

DEFAULT_CONFIG = CONFIGS / "e2e.yaml"  # with which the file of another track is read
OLD = {  # names in files without config, and the same race now
    "authors_code": "e2e_paper +authors_code",
    "e2e": "e2e +residual",
    "e2e_adaptive": "e2e +residual +disturbance",
    "e2e_clear": "e2e +fastest +clear",
    "e2e_disturbed": "e2e +disturbance",
    "e2e_estimated": "e2e +estimated",
    "e2e_fastest": "e2e +fastest",
    "e2e_fastest_disturbed": "e2e +fastest +disturbance",
    "e2e_ppo_residual": "e2e_ppo +residual",
    "e2e_robust": "e2e +robust",
    "e2e_shac": "e2e",
    "indi": "indi +fastest",
    "indi_fastest": "indi +fastest",
    "indi_shac": "indi",
}


def race_of_policy(
    policy: Policy,
    name: Path | str = "policy",
    config: Path | str | Config | None = None,
    track: str | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[Config, str]:
    """The config of the race that a policy flies, and where it came from.

    It is the first of: ``config``; the config in the policy file; the preset that
    ``source.config`` of the file names, as ``e2e`` or ``e2e_seed3``, with the residual of
    ``source.residual``. Files next to the policy file are not read.

    Args:
        policy: the policy.
        name: of its file, for messages.
        config: a config, a preset's name or a YAML file that the user names.
        track: a track file that replaces the config's.
        report: called with a line of text if the race is that of a preset.

    Raises:
        InputError: none of them, a config in the policy file that names code, or a file that
            cannot be read.
    """
    if isinstance(config, Config):
        race, origin = config, "config"
    elif config is not None:
        race, origin = load_config(config), str(config)
    elif policy.config is not None:
        race, origin = stored_config(policy.config, str(name)), "the policy file's config"
    elif preset := preset_of(policy):
        race = load_config(preset, _residual(policy))
        origin = f"preset {preset}, which the policy file names"
        report(f"{name}: flies the race of the {origin}")
    else:
        raise InputError(
            f"{name}: contains no config and names no preset, name the config of its race "
            "(config=CONFIG)"
        )
    if track is not None:
        overrides = [f"track={track}", "rules.position_limit=null"]
        race = race.replace(track=load_config(DEFAULT_CONFIG, overrides).track)
        origin = f"{origin}, track {track}"
    return race, origin


def preset_of(policy: Policy) -> str | None:
    """The preset that a policy file without a config names, if it comes with the package.

    Such files are of earlier versions; the preset of the same race now may have parts:
    ``e2e +residual``.
    """
    if policy.config is not None:
        return None
    preset = re.sub(r"_seed\d+$", "", str(policy.source.get("config")))
    return OLD.get(preset, preset if preset in preset_names() else None)


def _residual(policy: Policy) -> list[str]:
    """The override of the residual that a policy file names; none if it names none."""
    if "residual" not in policy.source:
        return []
    named = policy.source["residual"]
    return [override("vehicle.residual", str(named) if named else None)]
