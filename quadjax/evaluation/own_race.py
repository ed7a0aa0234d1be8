"""The race that a policy was trained in, from its file."""

import re
from pathlib import Path

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.config.stored import stored_config
from quadjax.core.errors import InputError
from quadjax.core.resources import preset_names
from quadjax.policy.file import Policy


def own_race(path: Path) -> Config:
    """The config in a policy file, or the preset that it names.

    Args:
        path: of the policy file.

    Raises:
        InputError: no config, or one that names code.
    """
    policy = Policy.load(path)
    own, preset = policy.config, re.sub(r"_seed\d+$", "", str(policy.source.get("config")))
    if own is None and preset in preset_names():
        return load_config(preset)
    if own is None:
        raise InputError(f"{path}: does not contain its config, name the race: --race CONFIG")
    return stored_config(own, str(path))
