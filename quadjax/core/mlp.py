"""A multilayer perceptron as a pure function of its layers."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

Layer = tuple[jax.Array, jax.Array]  # kernel (inputs, outputs) and bias (outputs,)
Layers = Sequence[Layer]

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {"relu": jax.nn.relu, "tanh": jnp.tanh}


def apply(layers: Layers, inputs: jax.Array, activation: str = "relu") -> jax.Array:
    """Evaluate a dense network.

    ``h_0 = x``, ``h_{i+1} = activation(h_i K_i + b_i)``; the last layer has no activation.

    Args:
        layers: kernel (inputs, outputs) and bias (outputs,) of each layer, in order.
        inputs: (..., inputs).
        activation: a key of ``ACTIVATIONS``.

    Returns:
        (..., outputs) of the last layer.
    """
    return _affine(*layers[-1], [inputs, *hidden(layers, inputs, activation)][-1])


def hidden(layers: Layers, inputs: jax.Array, activation: str = "relu") -> list[jax.Array]:
    """The activations (..., outputs) of each hidden layer; arguments as of ``apply``."""
    activations: list[jax.Array] = []
    for kernel, bias in layers[:-1]:
        inputs = ACTIVATIONS[activation](_affine(kernel, bias, inputs))
        activations.append(inputs)
    return activations


def _affine(kernel: jax.Array, bias: jax.Array, inputs: jax.Array) -> jax.Array:
    product = inputs @ kernel
    return product + bias.reshape((1,) * (product.ndim - 1) + (-1,))
