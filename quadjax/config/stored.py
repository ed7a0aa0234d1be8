"""Configs that are stored in policy files."""

from collections.abc import Iterator, Mapping
from typing import Any

from quadjax.config.loading import config_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError

CODE = (
    ("vehicle", "model"),
    ("learner", "algorithm"),
    ("observation", "extra"),
    ("reward", "terms"),
    ("rules", "extra"),
)  # keys whose values may be module:object


def stored_config(tree: dict[str, Any], file: str) -> Config:
    """The config in a policy file.

    Code comes from a config that the user names, never from a policy file: one whose config has
    objects of the user's own modules is rejected.

    Args:
        tree: the config in the file.
        file: the policy file, for messages.

    Raises:
        InputError: a key or a value that is not allowed, or that names code.
    """
    for key, name in _named_code(tree):
        raise InputError(
            f"{file}: {key} of its config is {name!r:.80}; code that a policy file names is not "
            "imported, name the config of its race"
        )
    return config_of(tree, f"{file}: config")


def _named_code(tree: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys and values of a config's tree that are ``module:object``."""
    for section, key in CODE:
        found = tree.get(section)
        value = found.get(key) if isinstance(found, dict) else None
        names = [value] if isinstance(value, str) else value or ()
        for name in names if isinstance(names, (list, tuple, dict)) else ():
            if isinstance(name, str) and ":" in name:
                yield f"{section}.{key}", name
