"""Values that are computed once and stored, where XLA's CPU backend would recompute them.

XLA fuses a cheap producer into each of its consumers and recomputes it there. A simulator is a
short chain of cheap operations with many outputs: each output recomputes the whole chain. The
functions here put values behind a conditional on a flag that is true, but unknown to the compiler.
XLA does not fuse through a conditional.

``jax.lax.optimization_barrier`` does not help: XLA's CPU pipeline removes barriers before it fuses.
For one step of the race (256 drones) XLA counts 1.7e6 operations without materialization, 2.0e6
with barriers (none is left in the compiled program), and 0.2e6 with conditionals; for the gradient
of 16 steps 3.0e6, 3.0e6 and 1.2e6 (a loop's body is counted once).

On other backends everything here is the plain function.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Result = TypeVar("Result")
Tree = TypeVar("Tree")
Caller = Callable[..., Any]  # (function, *arguments) -> function(*arguments)


def call_directly(function: Callable[..., Result], *arguments: Any) -> Result:
    """``function(*arguments)``: the ``Caller`` that materializes nothing."""
    return function(*arguments)


@jax.custom_vjp
def _conditional(tree: Tree, opaque_true: jax.Array) -> Tree:
    return jax.lax.cond(
        opaque_true,
        lambda values: values,
        lambda values: jax.tree.map(jnp.zeros_like, values),
        tree,
    )


def _forward(tree: Tree, opaque_true: jax.Array) -> tuple[Tree, jax.Array]:
    return _conditional(tree, opaque_true), opaque_true


def _backward(opaque_true: jax.Array, cotangent: Tree) -> tuple[Tree, None]:
    return _conditional(cotangent, opaque_true), None


_conditional.defvjp(_forward, _backward)


def materialize(tree: Tree, opaque_true: jax.Array) -> Tree:
    """The same values, computed once; so are their cotangents in the backward pass.

    Args:
        tree: any pytree of arrays.
        opaque_true: () bool that is true, traced, and the same for all of a batch, so that the
            compiler does not know it.
    """
    if jax.default_backend() != "cpu":
        return tree
    return _conditional(tree, opaque_true)


@jax.custom_vjp
def _conditional_cotangent(tree: Tree, opaque_true: jax.Array) -> Tree:
    return tree


_conditional_cotangent.defvjp(_forward, _backward)


def materialize_cotangent(tree: Tree, opaque_true: jax.Array) -> Tree:
    """As ``materialize``, but only where gradients flow.

    For values that are in memory already, such as a loop's carry. Arguments as of ``materialize``.
    """
    if jax.default_backend() != "cpu":
        return tree
    return _conditional_cotangent(tree, opaque_true)


def materializing(opaque_true: jax.Array, gradients: bool = False) -> Caller:
    """A ``Caller`` that computes ``function(*arguments)`` once, inside the conditional.

    As ``materialize(function(*arguments), opaque_true)``, without its copy of every value. The
    functions that it calls must be pure and close over no traced value.

    Args:
        opaque_true: as of ``materialize``.
        gradients: where gradients flow, use ``materialize``; False: ``function(*arguments)``.
    """

    def call(function: Callable[..., Result], *arguments: Any) -> Result:
        def differentiated(arguments: tuple, opaque_true: jax.Array) -> Result:
            result = function(*arguments)
            return materialize(result, opaque_true) if gradients else result

        return _inside_conditional(function, differentiated)(arguments, opaque_true)

    return call if jax.default_backend() == "cpu" else call_directly


def _inside_conditional(
    function: Callable[..., Result], differentiated: Callable[[tuple, jax.Array], Result]
) -> Callable[[tuple, jax.Array], Result]:
    """``function`` inside a conditional; ``differentiated`` in its place where gradients flow."""

    @jax.custom_vjp
    def once(arguments: tuple, opaque_true: jax.Array) -> Result:
        shapes = jax.eval_shape(function, *arguments)

        def zeros(_: tuple) -> Result:
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        return jax.lax.cond(opaque_true, lambda values: function(*values), zeros, arguments)

    def forward(arguments: tuple, opaque_true: jax.Array) -> tuple[Result, Callable]:
        return jax.vjp(lambda values: differentiated(values, opaque_true), arguments)

    def backward(pull: Callable, cotangent: Result) -> tuple:
        return pull(cotangent)[0], None

    once.defvjp(forward, backward)
    return once
