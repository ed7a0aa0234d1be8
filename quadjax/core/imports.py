"""Objects of a user's own modules, named by strings: ``"module:name"``."""

import importlib
import os
import sys

from quadjax.core.errors import InputError


def load_object(path: str, key: str) -> object:
    """Import an object.

    The current folder is searched first, so that a file next to a config is found however the
    program was started.

    Args:
        path: ``"package.module:name"``; the name may be dotted (``"module:Class.method"``).
        key: the config key that holds ``path``, for the error message.

    Raises:
        InputError: not of that form, no such module, an error in the module, or no such name in it.
    """
    module_name, colon, name = path.partition(":")
    if not (colon and name and all(part.isidentifier() for part in module_name.split("."))):
        raise InputError(f'{key} is {path!r}, allowed: "module:name"')
    try:
        found = _import(module_name)
    except Exception as error:  # a user's module may raise anything
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{key}: module {module_name} cannot be imported ({reason})") from error
    for part in name.split("."):
        if not hasattr(found, part):
            where = getattr(found, "__file__", module_name)
            raise InputError(f"{key} is {path!r}, but {where} has no {part!r}")
        found = getattr(found, part)
    return found


def _import(module_name: str) -> object:
    here = os.getcwd()
    if here in sys.path or "" in sys.path:
        return importlib.import_module(module_name)
    sys.path.insert(0, here)
    try:
        return importlib.import_module(module_name)
    finally:
        sys.path.remove(here)
