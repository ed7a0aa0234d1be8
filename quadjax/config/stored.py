"""Configs that are stored in files, and the code that configs name."""

from typing import Any

from quadjax.config.code import named_code, refuse_code
from quadjax.config.loading import config_of
from quadjax.config.schema import Config


def names_of_code(config: Config) -> list[str]:
    """The objects ``module:OBJECT`` of the user's own modules that a config names."""
    return [name for _, name in named_code(config.model_dump(by_alias=True))]


def stored_config(tree: dict[str, Any], file: str) -> Config:
    """The config in a policy file.

    Args:
        tree: the config in the file.
        file: the policy file, for messages.

    Raises:
        InputError: a key or a value that is not allowed, or that names code.
    """
    source = f"{file}: config"
    refuse_code(tree, source)
    return config_of(tree, source)
