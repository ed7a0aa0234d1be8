"""A multilayer perceptron in Flax, and its parameters as the layers of files.

The parameters of an ``MLP`` are ``{"Dense_0": {"kernel": (inputs, outputs), "bias": (outputs,)},
"Dense_1": ..}``, as of any Flax module. Files have the same arrays as a sequence of layers.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

Array = jax.Array | np.ndarray
Layers = Sequence[tuple[Array, Array]]  # kernel (inputs, outputs) and bias (outputs,), in order
Params = Mapping[str, Any]  # of a Flax module

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"relu": nn.relu, "tanh": nn.tanh}


class MLP(nn.Module):
    """Dense layers with an activation after each but the last.

    ``h_0 = x``, ``h_{i+1} = activation(h_i K_i + b_i)``. Kernels are initialized orthogonal, scaled
    by sqrt(2), and by ``last_scale`` in the last layer; biases are initialized to zero.

    Attributes:
        features: outputs of each layer, the last included.
        activation: a key of ``ACTIVATIONS``.
        last_scale: scale of the last layer's initial kernel.
    """

    features: tuple[int, ...]
    activation: str = "relu"
    last_scale: float = 1.0

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Outputs (..., features[-1]) of inputs (..., n)."""
        *widths, outputs = self.features
        for width in widths:
            dense = nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))
            inputs = ACTIVATIONS[self.activation](dense(inputs))
        return nn.Dense(outputs, kernel_init=nn.initializers.orthogonal(self.last_scale))(inputs)


def apply(params: Params, inputs: jax.Array, activation: str = "relu") -> jax.Array:
    """The outputs (..., outputs) of a perceptron with given parameters, of inputs (..., n)."""
    features = tuple(bias.shape[-1] for _, bias in to_layers(params))
    return apply_module(MLP(features, activation), params, inputs)


def apply_module(
    module: nn.Module, params: Params, inputs: jax.Array, method: str = "__call__"
) -> jax.Array:
    """The array that a method of a module computes with given parameters."""
    return jnp.asarray(module.apply({"params": params}, inputs, method=method))


def to_layers(params: Params) -> tuple[tuple[Array, Array], ...]:
    """Kernel and bias of each layer of a perceptron's parameters."""
    layers = (params[f"Dense_{index}"] for index in range(len(params)))
    return tuple((layer["kernel"], layer["bias"]) for layer in layers)


def to_params(layers: Layers) -> Params:
    """The parameters of a perceptron with given kernels and biases."""
    return {
        f"Dense_{index}": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
        for index, (kernel, bias) in enumerate(layers)
    }
