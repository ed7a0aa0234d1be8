import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.materialize import (
    call_directly,
    call_materialized,
    call_materialized_forward,
    materialize,
    materialize_cotangent,
)

TREE = {"a": jnp.array([0.3, -0.7, 2.0]), "b": (jnp.array([1.0, 2.0, 3.0]),)}


def chain(tree, opaque_true, stored):
    first = jax.tree.map(jnp.sin, tree)
    first = materialize(first, opaque_true) if stored else first
    second = jax.tree.map(lambda x: x * x + first["a"], first)
    second = materialize(second, opaque_true) if stored else second
    return second["a"] * second["b"][0]


def test_values_are_the_same():
    for function in (lambda t, on: materialize(t, on), jax.jit(materialize)):
        kept = function(TREE, jnp.asarray(True))
        jax.tree.map(np.testing.assert_array_equal, kept, TREE)
    batched = jax.jit(jax.vmap(materialize, in_axes=(0, None)))(TREE, jnp.asarray(True))
    jax.tree.map(np.testing.assert_array_equal, batched, TREE)


def test_gradients_are_the_same():
    def slope(stored):
        def total(tree, opaque_true):
            return jnp.sum(
                jax.vmap(lambda t, on: chain(t, on, stored), in_axes=(0, None))(tree, opaque_true)
            )

        return jax.jit(jax.grad(total))(TREE, jnp.asarray(True))

    jax.tree.map(np.testing.assert_array_equal, slope(True), slope(False))
    assert np.abs(slope(True)["a"]).min() > 0.01


def once(x, y):
    return {"product": x["a"] * y, "positive": x["a"] > 0, "sine": jnp.sin(x["b"][0])}


CALLERS = {
    "call_materialized": call_materialized,
    "call_materialized_forward": call_materialized_forward,
    "call_directly": lambda function, _, *arguments: call_directly(function, *arguments),
}


@pytest.mark.parametrize("name", CALLERS)
def test_a_materialized_function_is_the_same_function(name):
    """Values and gradients, of one and of a batch, with flags among the results."""
    y, opaque_true = jnp.array([0.5, 2.0, -1.0]), jnp.asarray(True)

    def stored(x, y, opaque_true):
        return CALLERS[name](once, opaque_true, x, y)

    found = jax.jit(stored)(TREE, y, opaque_true)
    jax.tree.map(np.testing.assert_array_equal, found, once(TREE, y))
    found = jax.jit(jax.vmap(stored, in_axes=(0, 0, None)))(TREE, y, opaque_true)
    jax.tree.map(np.testing.assert_array_equal, found, once(TREE, y))

    def total(function):
        def one(x, y):
            result = function(x, y)
            return jnp.where(result["positive"], result["product"], result["sine"]) ** 2

        return lambda x, y: jnp.sum(jax.vmap(one)(x, y))

    slope = jax.jit(jax.grad(total(lambda x, y: stored(x, y, opaque_true)), (0, 1)))(TREE, y)
    wanted = jax.grad(total(once), (0, 1))(TREE, y)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), slope, wanted)
    assert np.abs(wanted[1]).max() > 0.1


def test_materialize_cotangent_changes_nothing():
    opaque_true = jnp.asarray(True)
    kept = jax.jit(materialize_cotangent)(TREE, opaque_true)
    jax.tree.map(np.testing.assert_array_equal, kept, TREE)

    def total(x):
        return jnp.sum(jnp.sin(materialize_cotangent({"x": x, "on": x > 0}, opaque_true)["x"]))

    slope = jax.jit(jax.grad(total))(TREE["a"])
    np.testing.assert_allclose(slope, np.cos(TREE["a"]), rtol=1e-6)
