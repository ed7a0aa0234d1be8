import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core import mlp

FUNCTIONS = {"relu": lambda x: np.maximum(x, 0.0), "tanh": np.tanh}


@pytest.mark.parametrize("activation", FUNCTIONS)
@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 5, 3)])
def test_apply_against_numpy(activation, shape):
    draw = np.random.default_rng(0)
    sizes = [3, 8, 6, 2]
    layers = [
        (draw.normal(size=(n, m)), draw.normal(size=m))
        for n, m in zip(sizes[:-1], sizes[1:], strict=True)
    ]
    inputs = draw.normal(size=shape)
    wanted = inputs
    for i, (kernel, bias) in enumerate(layers):
        wanted = wanted @ kernel + bias
        wanted = FUNCTIONS[activation](wanted) if i < 2 else wanted
    single = [(jnp.float32(kernel), jnp.float32(bias)) for kernel, bias in layers]
    found = mlp.apply(single, jnp.float32(inputs), activation)
    np.testing.assert_allclose(found, wanted, rtol=2e-4, atol=1e-5)
    assert found.shape == (*shape[:-1], 2)
