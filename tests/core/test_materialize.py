"""What is materialized has the same values and gradients."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.materialize import materialize, materialize_cotangent, materialized

TREE = {"a": jnp.array([0.3, -0.7, 2.0]), "b": (jnp.array([1.0, 2.0, 3.0]),)}


def once(x, y):
    return {"product": x["a"] * y, "positive": x["a"] > 0, "sine": jnp.sin(x["b"][0])}


CALLERS = {
    "materialize": lambda function, on, *arguments: materialize(function(*arguments), on),
    "materialize_cotangent": lambda function, on, x, y: function(materialize_cotangent(x, on), y),
    "with gradients": lambda f, flag, *x: materialized(gradients=True)(f)(*x, opaque_true=flag),
    "forward": lambda f, flag, *x: materialized()(f)(*x, opaque_true=flag),
    "static": lambda f, flag, *x: materialized(static=1)(lambda g, *x: g(*x))(
        f, *x, opaque_true=flag
    ),
    "without a flag": lambda f, _, *arguments: materialized()(f)(*arguments),
}


@pytest.mark.parametrize("name", CALLERS)
def test_a_materialized_function_is_the_same_function(name):
    """Values and gradients, of one and of a batch, with flags among the results."""
    y, opaque_true = jnp.array([0.5, 2.0, -1.0]), jnp.asarray(True)

    def stored(x, y, opaque_true):
        return CALLERS[name](once, opaque_true, x, y)

    values = jax.jit(stored)(TREE, y, opaque_true)
    chex.assert_trees_all_equal(values, once(TREE, y))
    values = jax.jit(jax.vmap(stored, in_axes=(0, 0, None)))(TREE, y, opaque_true)
    chex.assert_trees_all_equal(values, once(TREE, y))

    def total(function):
        def one(x, y):
            result = function(x, y)
            return jnp.where(result["positive"], result["product"], result["sine"]) ** 2

        return lambda x, y: jnp.sum(jax.vmap(one)(x, y))

    slope = jax.jit(jax.grad(total(lambda x, y: stored(x, y, opaque_true)), (0, 1)))(TREE, y)
    wanted = jax.grad(total(once), (0, 1))(TREE, y)
    chex.assert_trees_all_close(slope, wanted, rtol=1e-6)
    assert np.abs(wanted[1]).max() > 0.1


def test_a_function_is_traced_once_for_all_programs_with_equal_static_arguments():
    calls = []

    @materialized(static=1)
    def scale(factor, x):
        calls.append(x)
        return factor * x

    for last in (3.0, 5.0):
        program = jax.jit(lambda on, x, last=last: last * scale(2.0, x, opaque_true=on))
        assert program(jnp.asarray(True), 1.5) == last * 3.0
    assert len(calls) == 1
    assert jax.jit(lambda on, x: scale(4.0, x, opaque_true=on))(jnp.asarray(True), 1.5) == 6.0
