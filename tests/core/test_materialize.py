import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.materialize import call, stage, stage_backwards, staged, staged_values

TREE = {"a": jnp.array([0.3, -0.7, 2.0]), "b": (jnp.array([1.0, 2.0, 3.0]),)}


def chain(tree, always, staged):
    first = jax.tree.map(jnp.sin, tree)
    first = stage(first, always) if staged else first
    second = jax.tree.map(lambda x: x * x + first["a"], first)
    second = stage(second, always) if staged else second
    return second["a"] * second["b"][0]


def test_values_are_the_same():
    for function in (lambda t, on: stage(t, on), jax.jit(stage)):
        kept = function(TREE, jnp.asarray(True))
        jax.tree.map(np.testing.assert_array_equal, kept, TREE)
    batched = jax.jit(jax.vmap(stage, in_axes=(0, None)))(TREE, jnp.asarray(True))
    jax.tree.map(np.testing.assert_array_equal, batched, TREE)


def test_flags_and_counts_pass():
    tree = {"flag": jnp.array([True, False]), "count": jnp.array([1, 2]), "x": jnp.ones(2)}
    kept = jax.jit(stage)(tree, jnp.asarray(True))
    jax.tree.map(np.testing.assert_array_equal, kept, tree)
    assert kept["flag"].dtype == bool


def test_gradients_are_the_same():
    def slope(staged):
        def total(tree, always):
            return jnp.sum(
                jax.vmap(lambda t, on: chain(t, on, staged), in_axes=(0, None))(tree, always)
            )

        return jax.jit(jax.grad(total))(TREE, jnp.asarray(True))

    jax.tree.map(np.testing.assert_array_equal, slope(True), slope(False))
    assert np.abs(slope(True)["a"]).min() > 0.01


def test_gradient_passes_beside_flags():
    def total(x, always):
        kept = stage({"x": x * x, "positive": x > 0, "count": jnp.arange(3)}, always)
        return jnp.sum(jnp.where(kept["positive"], kept["x"], 0.0))

    slope = jax.jit(jax.grad(total))(TREE["a"], jnp.asarray(True))
    np.testing.assert_allclose(slope, [0.6, 0.0, 4.0], rtol=1e-6)


def once(x, y):
    return {"product": x["a"] * y, "positive": x["a"] > 0, "sine": jnp.sin(x["b"][0])}


KEEPERS = {
    "staged": staged,
    "staged_values": staged_values,
    "call": lambda function, _, *arguments: call(function, *arguments),
}


@pytest.mark.parametrize("name", KEEPERS)
def test_a_function_kept_is_the_same_function(name):
    """Values and gradients, of one and of a batch, with flags among the results."""
    y, always = jnp.array([0.5, 2.0, -1.0]), jnp.asarray(True)

    def kept(x, y, always):
        return KEEPERS[name](once, always, x, y)

    found = jax.jit(kept)(TREE, y, always)
    jax.tree.map(np.testing.assert_array_equal, found, once(TREE, y))
    found = jax.jit(jax.vmap(kept, in_axes=(0, 0, None)))(TREE, y, always)
    jax.tree.map(np.testing.assert_array_equal, found, once(TREE, y))

    def total(function):
        def one(x, y):
            result = function(x, y)
            return jnp.where(result["positive"], result["product"], result["sine"]) ** 2

        return lambda x, y: jnp.sum(jax.vmap(one)(x, y))

    slope = jax.jit(jax.grad(total(lambda x, y: kept(x, y, always)), (0, 1)))(TREE, y)
    wanted = jax.grad(total(once), (0, 1))(TREE, y)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), slope, wanted)
    assert np.abs(wanted[1]).max() > 0.1


def test_stage_backwards_changes_nothing():
    always = jnp.asarray(True)
    kept = jax.jit(stage_backwards)(TREE, always)
    jax.tree.map(np.testing.assert_array_equal, kept, TREE)

    def total(x):
        return jnp.sum(jnp.sin(stage_backwards({"x": x, "on": x > 0}, always)["x"]))

    slope = jax.jit(jax.grad(total))(TREE["a"])
    np.testing.assert_allclose(slope, np.cos(TREE["a"]), rtol=1e-6)
