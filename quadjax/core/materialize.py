"""Values that are computed once and stored, where XLA's CPU backend would recompute them.

XLA fuses a cheap producer into each of its consumers and recomputes it there. A simulator is a
short chain of cheap operations with many outputs: each output recomputes the whole chain. The
functions here put values behind a conditional on ``opaque_true``, which is always true, although
the compiler cannot know it. XLA does not fuse through a conditional.

All of this changes the speed on CPUs, and no value: ignore ``opaque_true`` while reading.

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

Result = TypeVar("Result")
Tree = TypeVar("Tree")


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


def materialize(tree: Tree, opaque_true: jax.Array | None) -> Tree:
    """The same values, computed once; so are their cotangents in the backward pass.

    Args:
        tree: any pytree of arrays.
        opaque_true: () bool that is true, traced, and the same for all of a batch, so that the
            compiler does not know it. None: the values are returned as they are.
    """
    if opaque_true is None or jax.default_backend() != "cpu":
        return tree
    return _conditional(tree, opaque_true)


@jax.custom_vjp
def _conditional_cotangent(tree: Tree, opaque_true: jax.Array) -> Tree:
    return tree


_conditional_cotangent.defvjp(_forward, _backward)


def materialize_cotangent(tree: Tree, opaque_true: jax.Array | None) -> Tree:
    """As ``materialize``, but only where gradients flow.

    For values that are in memory already, such as a loop's carry. Arguments as of ``materialize``.
    """
    if opaque_true is None or jax.default_backend() != "cpu":
        return tree
    return _conditional_cotangent(tree, opaque_true)


def materialized(
    static: int = 0, gradients: bool = False
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """A decorator of pure functions whose result is computed once, inside the conditional.

    The function takes one more keyword, ``opaque_true``: that of ``materialize``; without it, or
    with None, it is the plain function. ``materialize(function(*arguments), opaque_true)`` has the
    same values, but copies each of them.

    Args:
        static: number of the function's first arguments that are static and hashable.
        gradients: whether gradients are materialized; else they are those of the plain function.
    """

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        once = _inside_conditional(function, static, gradients)

        @functools.wraps(function)
        def call(*arguments: Any, opaque_true: jax.Array | None = None) -> Result:
            if opaque_true is None or jax.default_backend() != "cpu":
                return function(*arguments)
            return once(arguments[:static], arguments[static:], opaque_true)

        return call

    return decorate


def _inside_conditional(
    function: Callable[..., Any], static: int, gradients: bool
) -> Callable[[tuple, tuple, jax.Array], Any]:
    """``function`` of static and other arguments and ``opaque_true``, inside a conditional.

    Where gradients flow it is the plain function, with ``gradients`` materialized.
    """
    # A function is traced once for all programs that call it.
    inlined = jax.jit(function, static_argnums=tuple(range(static)), inline=True)

    @functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
    def once(fixed: tuple, arguments: tuple, opaque_true: jax.Array) -> Any:
        def compute(arguments: tuple) -> Any:
            return inlined(*fixed, *arguments)

        def zeros(arguments: tuple) -> Any:
            shapes = jax.eval_shape(compute, arguments)
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        return jax.lax.cond(opaque_true, compute, zeros, arguments)

    def forward(fixed: tuple, arguments: tuple, opaque_true: jax.Array) -> tuple[Any, Callable]:
        def differentiated(values: tuple) -> Any:
            result = function(*fixed, *values)
            return materialize(result, opaque_true) if gradients else result

        return jax.vjp(differentiated, arguments)

    def backward(fixed: tuple, pull: Callable, cotangent: Any) -> tuple:
        return pull(cotangent)[0], None

    once.defvjp(forward, backward)
    return once
