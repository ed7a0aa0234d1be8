"""The race of a policy file: the config that every command flies it in."""

from pathlib import Path

from quadjax.config.loading import load_config, stored_config, with_track
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.policy.file import Policy


def race_of_policy(
    policy: Policy,
    name: Path | str = "policy",
    config: Path | str | Config | None = None,
    track: str | None = None,
) -> tuple[Config, str]:
    """The config of the race that a policy flies, and where it came from.

    It is ``config``, or else the config in the policy file. Files next to it are not read.

    Args:
        policy: the policy.
        name: of its file, for messages.
        config: a config, a preset's name or a YAML file that the user names.
        track: a track file that replaces the config's, with its rules.

    Raises:
        InputError: neither of them, a config in the policy file that names code, or a file that
            cannot be read.
    """
    if isinstance(config, Config):
        race, origin = config, "config"
    elif config is not None:
        race, origin = load_config(config), str(config)
    elif policy.config is not None:
        race, origin = stored_config(policy.config, str(name)), "the policy file's config"
    else:
        raise InputError(f"{name}: has no config; name the config of its race (config=CONFIG)")
    if track is not None:
        race = with_track(race, track)
        origin = f"{origin}, track {track}"
    return race, origin
