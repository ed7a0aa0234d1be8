"""Objects of a user's own modules, named by strings: ``"module:name"``, and calls of them."""

import importlib
import os
import re
import sys
from collections.abc import Callable
from typing import Any

from quadjax.core.errors import USER_ERRORS, USER_FILES, InputError, close_match, user_error


def load_object(path: str, key: str) -> object:
    """Import an object.

    The current folder is searched too, however the program was started: first, unless
    ``sys.path`` has it at another place.

    Args:
        path: ``"package.module:name"``; the name may be dotted (``"module:Class.method"``), and
            the module's name may begin with a digit (``04_race.py``).
        key: the config key that holds ``path``, for the error message.

    Raises:
        InputError: not of that form, no such module, an error in the module, or no such name in it.
    """
    module_name, colon, name = path.partition(":")
    if not (colon and name and re.fullmatch(r"\w+(\.\w+)*", module_name)):
        raise InputError(f'{key} is {path!r}, allowed: "module:name"')
    try:
        value = _import(module_name)
    except USER_ERRORS as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{key}: module {module_name} cannot be imported ({reason})") from error
    file = getattr(value, "__file__", None) or module_name
    USER_FILES.add(file)
    for attribute in name.split("."):
        if not hasattr(value, attribute):
            hint = close_match(attribute, dir(value))
            raise InputError(f"{key} is {path!r}, but {file} has no {attribute!r}{hint}")
        value = getattr(value, attribute)
    return value


def _import(module_name: str) -> object:
    here = os.getcwd()
    if here in sys.path or "" in sys.path:
        return importlib.import_module(module_name)
    sys.path.insert(0, here)
    try:
        return importlib.import_module(module_name)
    finally:
        sys.path.remove(here)


def user_numbers(
    label: str, function: Callable[[Any], Any], argument: object, size: int | None = None
) -> list[Any]:
    """The result of a user's own function, checked to consist of scalars.

    Args:
        label: of the function, for messages: ``reward term own:fast``.
        function: of one argument.
        argument: its argument.
        size: number of scalars in the sequence that it returns; None for one scalar alone.

    Raises:
        InputError: the function raises an error, or returns something else; in one line.
    """
    try:
        result = function(argument)
        values = [result] if size is None else list(result)
    except InputError:
        raise
    except USER_ERRORS as error:
        raise InputError(f"{label}: {user_error(error)}") from error
    wanted = "one number" if size in (None, 1) else f"{size} numbers"
    if size is not None and len(values) != size:
        raise InputError(f"{label} gives {len(values)} numbers, expected {wanted} (its size)")
    for value in values:
        shape = getattr(value, "shape", () if isinstance(value, (bool, int, float)) else None)
        if shape != ():
            what = f"{value!r:.40}" if shape is None else f"an array of shape {shape}"
            raise InputError(f"{label} gives {what}, expected {wanted} of shape ()")
    return values
