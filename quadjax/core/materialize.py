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

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from quadjax.core.sharing import cached

Result = TypeVar("Result")
Tree = TypeVar("Tree")
Caller = Callable[..., Any]  # (function, *arguments) -> function(*arguments)


def call_directly(function: Callable[..., Result], *arguments: Any) -> Result:
    """``function(*arguments)``: the ``Caller`` that materializes nothing."""
    return function(*arguments)


@jax.custom_vjp
def _conditional(tree: Tree, opaque_true: jax.Array) -> Tree:
    return jax.lax.cond(opaque_true, _same, _zeros_like, tree)


def _same(tree: Tree) -> Tree:
    return tree


def _zeros_like(tree: Tree) -> Tree:
    return jax.tree.map(jnp.zeros_like, tree)


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
        return _inside_conditional(function, gradients)(arguments, opaque_true)

    return call if jax.default_backend() == "cpu" else call_directly


@functools.partial(cached, count=64)  # a function is traced once for all programs that call it
def _inside_conditional(
    function: Callable[..., Any], gradients: bool
) -> Callable[[tuple, jax.Array], Any]:
    """``function`` of a tuple of arguments and the flag, inside a conditional.

    Where gradients flow it is the plain function, with ``gradients`` materialized.
    """
    inlined = jax.jit(function, inline=True)  # keeps its trace

    def compute(arguments: tuple) -> Any:
        return inlined(*arguments)

    def zeros(arguments: tuple) -> Any:
        shapes = jax.eval_shape(inlined, *arguments)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    @jax.custom_vjp
    def once(arguments: tuple, opaque_true: jax.Array) -> Any:
        return jax.lax.cond(opaque_true, compute, zeros, arguments)

    def forward(arguments: tuple, opaque_true: jax.Array) -> tuple[Any, Callable]:
        def differentiated(values: tuple) -> Any:
            result = function(*values)
            return materialize(result, opaque_true) if gradients else result

        return jax.vjp(differentiated, arguments)

    def backward(pull: Callable, cotangent: Any) -> tuple:
        return pull(cotangent)[0], None

    once.defvjp(forward, backward)
    return once
