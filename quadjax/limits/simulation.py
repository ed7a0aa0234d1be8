"""Flights of the vehicle model by commands, and when they pass their gates."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.integrators import INTEGRATORS, rk4_loop_step
from quadjax.limits.problem import Problem, leaves


def make_step(
    problem: Problem, time_step: float, integrator: str = "rk4"
) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """``(state (leaves,), command (commands,)) -> state`` after a time step.

    Quaternions are normalized; angles are not wrapped.
    """
    quaternion, model = jnp.asarray(problem.normalized), problem.model
    advance = rk4_loop_step if integrator == "rk4" else INTEGRATORS[integrator]

    def step(state: jax.Array, command: jax.Array) -> jax.Array:
        held = problem.command(command)

        def slope(drone: jax.Array) -> jax.Array:
            return _vector(model.derivative(problem.vehicle, problem.state(drone), held))

        after = advance(slope, _vector(model.hold(problem.state(state), held)), time_step)
        wrapped = _vector(model.wrap(problem.state(after)))
        return jnp.where(quaternion, wrapped, after)

    return step


def _vector(tree: Any) -> jax.Array:
    return jnp.stack([jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)])


@functools.partial(jax.jit, static_argnames=("problem", "time_step", "integrator"))
def _simulate(
    problem: Problem, first: jax.Array, commands: jax.Array, time_step: float, integrator: str
) -> jax.Array:
    step = make_step(problem, time_step, integrator)

    def advance(state: jax.Array, command: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = step(state, command)
        return after, after

    return jax.lax.scan(advance, first, commands)[1]


def simulate(
    problem: Problem,
    commands: np.ndarray,
    time_step: float,
    integrator: str = "rk4",
    first: np.ndarray | None = None,
) -> np.ndarray:
    """States (steps + 1, leaves) in float64 of commands (steps, commands), each held for a step.

    From hover, or from the leaves ``first``. Angles are not wrapped.
    """
    first = leaves(problem.hover_state) if first is None else first
    with jax.enable_x64(True):
        rows = _simulate(problem, jnp.asarray(first), jnp.asarray(commands), time_step, integrator)
        return np.concatenate([first[None], np.asarray(rows)])


def positions(problem: Problem, states: np.ndarray) -> np.ndarray:
    """Positions (n, 3), m, of state leaves (n, leaves)."""
    return vectors(problem, states, "position")


def velocities(problem: Problem, states: np.ndarray) -> np.ndarray:
    """Velocities (n, 3), m/s, of state leaves (n, leaves)."""
    return vectors(problem, states, "velocity")


def vectors(problem: Problem, states: np.ndarray, name: str) -> np.ndarray:
    """A vector (n, 3) of state leaves (n, leaves): a function of the model, by its name."""
    with jax.enable_x64(True):
        vector = getattr(problem.model, name)(problem.state(jnp.asarray(states).T))
        parts = [np.broadcast_to(np.asarray(x), len(states)) for x in vector.components()]
    return np.stack(parts, axis=1)


def crossings(
    problem: Problem,
    flown: np.ndarray,
    time_step: float,
    order: np.ndarray,
    tolerance: float = 0.0,
    openings: bool = False,
) -> tuple[np.ndarray, float]:
    """When a flight passes its gates, missing none by more than ``tolerance``, m.

    Args:
        problem: the flight.
        flown: (n, 3) positions, m.
        time_step: s, between them.
        order: (gates,) indices of the gates.
        tolerance: m.
        openings: anywhere in the openings, whatever clearance the problem requires.

    Returns:
        The times (gates passed,), s, where straight lines between the samples cross the planes, and
        the smallest ``Problem.leeway``, m, negative where a gate was missed; times end there.
    """
    times: list[float] = []
    clearance, step = np.inf, 0
    measure = problem.gates.clearance if openings else problem.leeway
    for gate in order:
        when, where = _passage(problem, flown, step, gate, tolerance)
        if not np.isfinite(when):
            break
        clearance = min(clearance, measure(gate, where))
        if clearance < -tolerance:
            break
        times.append(when * time_step)
        step = int(when) + (problem.gates.waypoint is None)
        if step + 1 >= len(flown):
            break
    return np.array(times), clearance


def _passage(
    problem: Problem, flown: np.ndarray, step: int, gate: int, tolerance: float
) -> tuple[float, np.ndarray]:
    """The first passage of a gate from ``step`` on: in steps, inf for none, and where."""
    gates = problem.gates
    offset = flown[step:] - gates.position[gate]
    if gates.waypoint is not None:
        return _near(np.linalg.norm(offset, axis=1), flown[step:], step, gates.waypoint, tolerance)
    ahead = offset @ gates.through[gate]
    (found,) = np.nonzero((ahead[:-1] < 0) & (ahead[1:] >= 0))
    if not len(found):
        return np.inf, flown[-1]
    index = int(found[0])
    fraction = -ahead[index] / (ahead[index + 1] - ahead[index])
    here, there = flown[step + index : step + index + 2]
    return step + index + fraction, here + fraction * (there - here)


def _near(
    distance: np.ndarray, flown: np.ndarray, step: int, radius: float, tolerance: float
) -> tuple[float, np.ndarray]:
    """The first sample within a radius; of a pass within the tolerance only, the nearest."""
    (found,) = np.nonzero(distance <= radius + tolerance)
    if not len(found):
        return np.inf, flown[-1]
    begin = found[0]
    (beyond,) = np.nonzero(distance[begin:] > radius + tolerance)
    part = distance[begin : begin + beyond[0] if len(beyond) else None]
    (within,) = np.nonzero(part <= radius)
    index = begin + (within[0] if len(within) else np.argmin(part))
    return step + index, flown[index]
