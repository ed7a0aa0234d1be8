"""Single precision, whatever a program that uses quadjax has set (``JAX_ENABLE_X64``).

Random numbers, parameters and thus laps differ with 64-bit types, so the public functions leave
them. Where quadjax itself needs double precision, it enables it in a block.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def single_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The function, computed and traced with JAX's 64-bit types disabled."""

    @functools.wraps(function)
    def computed(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if not jax.config.values["jax_enable_x64"]:
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return computed
