"""Fixed-step integrators over any state that is a pytree of arrays."""

from collections.abc import Callable
from typing import TypeVar

import jax

State = TypeVar("State")
Derivative = Callable[[State], State]
Integrator = Callable[[Derivative, State, float], State]


def _advance(state: State, slope: State, step: float) -> State:
    return jax.tree.map(lambda x, dx: x + step * dx, state, slope)


def euler_step(derivative: Derivative, state: State, dt: float) -> State:
    """One explicit Euler step of ``dt`` seconds."""
    return _advance(state, derivative(state), dt)


def rk4_step(derivative: Derivative, state: State, dt: float) -> State:
    """One step of the classical fourth-order Runge-Kutta method of ``dt`` seconds."""
    k1 = derivative(state)
    k2 = derivative(_advance(state, k1, 0.5 * dt))
    k3 = derivative(_advance(state, k2, 0.5 * dt))
    k4 = derivative(_advance(state, k3, dt))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
    return _advance(state, mean, dt)


INTEGRATORS: dict[str, Integrator] = {"euler": euler_step, "rk4": rk4_step}
