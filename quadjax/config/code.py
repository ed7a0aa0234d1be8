"""Objects of the user's own modules that a config names as ``module:OBJECT``."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from quadjax.config.schema import Config
from quadjax.core.errors import InputError

CODE = (
    ("vehicle", "model"),
    ("learner", "algorithm"),
    ("observation", "extra"),
    ("reward", "terms"),
    ("rules", "extra"),
)  # keys whose values may be module:object


def refuse_code(tree: Mapping[str, Any], source: str, allowed: Collection[str] = ()) -> None:
    """Reject the tree of a config that names code.

    Code is imported from the command line and from a config that the user names, never from a
    file that the program finds: in a policy file, in the folder of a run or of an export.

    Args:
        tree: of the config.
        source: the file, for messages.
        allowed: names ``module:object`` that the user has given elsewhere.

    Raises:
        InputError: with the first key that names code.
    """
    for key, name in named_code(tree):
        if name in allowed:
            continue
        raise InputError(
            f"{source}: {key} is {name!r:.80}; code that this file names is not imported, name "
            "the config of its race (config=CONFIG)"
        )


def named_code(tree: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys and values of a config's tree that are ``module:object``."""
    for section, key in CODE:
        values = tree.get(section)
        value = values.get(key) if isinstance(values, dict) else None
        names = [value] if isinstance(value, str) else value or ()
        for name in names if isinstance(names, (list, tuple, dict)) else ():
            if isinstance(name, str) and ":" in name:
                yield f"{section}.{key}", name


def names_of_code(config: Config) -> list[str]:
    """The objects ``module:OBJECT`` of the user's own modules that a config names."""
    return [name for _, name in named_code(config.model_dump(by_alias=True))]
