"""The race that a policy was trained in, from its file."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from quadjax.config.loading import config_of, load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import preset_names
from quadjax.policy.file import Policy

CODE = (
    ("vehicle", "model"),
    ("learner", "algorithm"),
    ("observation", "extra"),
    ("reward", "terms"),
    ("rules", "extra"),
)  # keys whose values may be module:object


def own_race(path: Path) -> Config:
    """The config in a policy file, or the preset that it names.

    As in ``quadjax.evaluate``, code comes from a config that the user names, never from a policy
    file: one whose config has objects of the user's own modules is rejected.

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
    for key, name in named_code(own):
        raise InputError(
            f"{path}: {key} of its config is {name!r:.80}; code that a policy file names is not "
            "imported, name the race: --race CONFIG"
        )
    return config_of(own, f"{path}: config")


def named_code(tree: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys and values of a config's tree that are ``module:object``."""
    for section, key in CODE:
        found = tree.get(section)
        value = found.get(key) if isinstance(found, dict) else None
        names = [value] if isinstance(value, str) else value or ()
        for name in names if isinstance(names, (list, tuple, dict)) else ():
            if isinstance(name, str) and ":" in name:
                yield f"{section}.{key}", name
