"""Fixed-step integrators over any state that is a pytree of arrays."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar

State = TypeVar("State")
Derivative = Callable[[State], State]
Integrator = Callable[[Derivative, State, Scalar], State]


def _advance(state: State, slope: State, step: Scalar) -> State:
    return jax.tree.map(lambda x, dx: x + step * dx, state, slope)


def euler_step(derivative: Derivative, state: State, dt: Scalar) -> State:
    """One explicit Euler step of ``dt`` seconds."""
    return _advance(state, derivative(state), dt)


def rk4_step(derivative: Derivative, state: State, dt: Scalar) -> State:
    """One step of the classical fourth-order Runge-Kutta method of ``dt`` seconds."""
    k1 = derivative(state)
    k2 = derivative(_advance(state, k1, 0.5 * dt))
    k3 = derivative(_advance(state, k2, 0.5 * dt))
    k4 = derivative(_advance(state, k3, dt))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
    return _advance(state, mean, dt)


def rk4_loop_step(
    derivative: Callable[[jax.Array], jax.Array], state: jax.Array, dt: Scalar
) -> jax.Array:
    """``rk4_step`` of one array, as a loop over the stages: it compiles faster and runs slower."""

    def stage(
        carry: tuple[jax.Array, jax.Array], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        (slope, total), (offset, weight) = carry, row
        slope = derivative(state + dt * offset * slope)
        return (slope, total + weight * slope), None

    stages = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    (_, mean), _ = jax.lax.scan(stage, (jnp.zeros_like(state), jnp.zeros_like(state)), stages)
    return state + dt * mean


INTEGRATORS: dict[str, Integrator] = {"euler": euler_step, "rk4": rk4_step}
