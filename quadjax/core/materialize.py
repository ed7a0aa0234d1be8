"""Stages: values that are computed once and kept, where a compiler would compute them again.

XLA's CPU backend fuses a cheap producer into each of its consumers and recomputes it there. A
simulator is a short chain with many outputs, so each output recomputed the whole chain: twenty
times the work. A conditional is the one thing that it does not fuse through.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

Result = TypeVar("Result")
Keep = Callable[..., Result]  # (function, *arguments) -> function(*arguments), computed once


def call(function: Callable[..., Result], *arguments: object) -> Result:
    """``function(*arguments)``: the ``Keep`` that leaves all to the compiler."""
    return function(*arguments)


@jax.custom_vjp
def _kept(tree: object, always: jax.Array) -> object:
    return jax.lax.cond(
        always,
        lambda values: values,
        lambda values: jax.tree.map(jax.numpy.zeros_like, values),
        tree,
    )


def _kept_forward(tree: object, always: jax.Array) -> tuple[object, jax.Array]:
    return _kept(tree, always), always


def _kept_backward(always: jax.Array, cotangent: object) -> tuple[object, None]:
    return _kept(cotangent, always), None


_kept.defvjp(_kept_forward, _kept_backward)


def stage(tree: object, always: jax.Array) -> object:
    """The same values, computed once, and their cotangents too on the way back.

    Args:
        tree: any pytree of arrays.
        always: () bool that is true, but traced and the same for all of a batch, so that the
            compiler cannot know it.
    """
    if jax.default_backend() != "cpu":
        return tree
    return _kept(tree, always)


@jax.custom_vjp
def _kept_backwards(tree: object, always: jax.Array) -> object:
    return tree


_kept_backwards.defvjp(_kept_forward, _kept_backward)


def stage_backwards(tree: object, always: jax.Array) -> object:
    """As ``stage``, but only where gradients flow: for values that are kept already, like a carry.

    Arguments as of ``stage``.
    """
    if jax.default_backend() != "cpu":
        return tree
    return _kept_backwards(tree, always)


def staged(function: Callable[..., Result], always: jax.Array, *arguments: object) -> Result:
    """``function(*arguments)``, computed once, inside the conditional that keeps it.

    The same as ``stage(function(*arguments), always)``, without its copy of every value. Where
    gradients flow it is just that.

    Args:
        function: pure, and closed over nothing that is traced.
        always: as of ``stage``.
        arguments: pytrees of arrays.
    """
    if jax.default_backend() != "cpu":
        return function(*arguments)

    def plain(arguments: tuple, always: jax.Array) -> Result:
        return stage(function(*arguments), always)

    return _once(function, plain)(arguments, always)


def staged_values(function: Callable[..., Result], always: jax.Array, *arguments: object) -> Result:
    """As ``staged``, but where gradients flow nothing is kept: just ``function(*arguments)``."""
    if jax.default_backend() != "cpu":
        return function(*arguments)
    return _once(function, lambda arguments, _: function(*arguments))(arguments, always)


def _once(
    function: Callable[..., Result], differentiated: Callable[[tuple, jax.Array], Result]
) -> Callable[[tuple, jax.Array], Result]:
    """``function`` inside a conditional; ``differentiated`` in its place where gradients flow."""

    @jax.custom_vjp
    def once(arguments: tuple, always: jax.Array) -> Result:
        shapes = jax.eval_shape(function, *arguments)

        def zeros(_: tuple) -> Result:
            return jax.tree.map(lambda x: jax.numpy.zeros(x.shape, x.dtype), shapes)

        return jax.lax.cond(always, lambda values: function(*values), zeros, arguments)

    def forward(arguments: tuple, always: jax.Array) -> tuple[Result, Callable]:
        return jax.vjp(lambda values: differentiated(values, always), arguments)

    def backward(pull: Callable, cotangent: Result) -> tuple:
        return pull(cotangent)[0], None

    once.defvjp(forward, backward)
    return once
