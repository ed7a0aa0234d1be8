"""The shapes and types of arrays that a user's own functions return, checked by chex."""

import chex
import jax.numpy as jnp
from jax.typing import ArrayLike

from quadjax.core.errors import InputError


def check_traced(
    what: str, value: ArrayLike, shape: tuple[int, ...], kind: type[float] | type[bool] = float
) -> None:
    """Check the shape and type of an array while it is traced.

    Raises:
        InputError: another shape or type.
    """
    try:
        chex.assert_shape(value, shape)
        chex.assert_type(value, kind)
    except AssertionError:
        found = f"the shape {jnp.shape(value)} and the type {jnp.result_type(value)}"
        raise InputError(f"{what} has {found}, expected {shape} and {kind.__name__}") from None
