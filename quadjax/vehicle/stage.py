"""Stages: values that are computed once and kept, where a compiler would compute them again.

XLA's CPU backend fuses a cheap producer into each of its consumers and recomputes it there. A
simulator is a short chain with many outputs, so each output recomputed the whole chain: twenty
times the work. A conditional is the one thing that it does not fuse through.
"""

import jax


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
