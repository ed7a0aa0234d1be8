"""Commands that follow a solution in the vehicle model: a linear-quadratic regulator along it.

A solution's commands alone drift: errors of its mesh grow with the length of the flight. The
regulator changes the commands, within their range, so that the simulated flight stays close. The
result is the simulated flight of these commands and is verified like any other flight.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from quadjax.limits.problem import Problem
from quadjax.limits.simulation import make_step
from quadjax.limits.trajectory import Trajectory

POSITION, VELOCITY, OTHERS = 0.03, 0.1, 0.03  # m, m/s, fraction of the largest value: tolerances
COMMAND = 0.1  # fraction of the range


def follow(
    problem: Problem, trajectory: Trajectory, time_step: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a solution with feedback; it continues after its end.

    Args:
        problem: the flight.
        trajectory: the solution.
        time_step: s, for which each command is held.
        steps: number of steps.

    Returns:
        States (steps + 1, leaves) and the commands (steps, commands) that lead to them.
    """
    states, commands = reference(problem, trajectory, time_step, steps)
    weight = np.full(states.shape[1], np.inf)
    weight[:] = OTHERS * np.maximum(np.abs(trajectory.states).max(axis=0), 0.1)
    weight[problem.leaf_indices("position")] = POSITION
    weight[problem.leaf_indices("velocity")] = VELOCITY
    low, high = problem.command_range
    effort = COMMAND * np.where(high > low, high - low, 1.0)
    with jax.enable_x64(True):
        rows, given = _follow(
            problem, time_step, *map(jnp.asarray, (states, commands, weight, effort, low, high))
        )
    return np.concatenate([states[:1], np.asarray(rows)]), np.asarray(given)


def reference(
    problem: Problem, trajectory: Trajectory, time_step: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, leaves) and commands (steps, commands) of a solution at equal steps.

    Beyond the end: of a periodic flight its next round, of another one its last values.
    """
    when = np.arange(steps + 1) * time_step
    middle = when[:-1] + 0.5 * time_step
    total, nodes = trajectory.total, trajectory.times
    change = np.zeros(trajectory.states.shape[1])
    if problem.start == "periodic":
        change = np.where(problem.angles, trajectory.states[-1] - trajectory.states[0], 0.0)
    over = when >= total if problem.start == "periodic" else np.zeros(len(when), bool)
    wrapped = np.minimum(np.where(over, when - total, when), total)
    states = curve(problem, trajectory)(wrapped) + np.where(over[:, None], change, 0.0)
    if problem.normalized.any() and problem.start == "periodic":
        mask = problem.normalized
        if trajectory.states[0, mask] @ trajectory.states[-1, mask] < 0.0:
            states[:, mask] *= np.where(over, -1.0, 1.0)[:, None]
    middle = middle % total if problem.start == "periodic" else np.minimum(middle, total)
    commands = [np.interp(middle, nodes, column) for column in trajectory.commands.T]
    return states, np.stack(commands, axis=1)


def curve(problem: Problem, trajectory: Trajectory) -> CubicHermiteSpline:
    """The solution as a function of time, with the slopes that the equations give."""

    def slope(state: jax.Array, command: jax.Array) -> jax.Array:
        held = problem.command(command)
        full = problem.model.hold(problem.state(state), held)
        return jnp.stack(
            [
                jnp.asarray(x)
                for x in jax.tree.leaves(problem.model.derivative(problem.vehicle, full, held))
            ]
        )

    with jax.enable_x64(True):
        pairs = map(jnp.asarray, (trajectory.states, trajectory.commands))
        slopes = np.asarray(jax.jit(jax.vmap(slope))(*pairs))
    return CubicHermiteSpline(trajectory.times, trajectory.states, slopes)


def refined(problem: Problem, trajectory: Trajectory, intervals: int) -> Trajectory:
    """A solution on a finer mesh: in the middle of an interval it has the collocation's state."""
    mesh = trajectory.resample(intervals)
    states = curve(problem, trajectory)(mesh.times)
    return Trajectory(mesh.leg_times, states, mesh.commands)


@functools.partial(jax.jit, static_argnames=("problem", "time_step"))
def _follow(
    problem: Problem,
    time_step: float,
    states: jax.Array,
    commands: jax.Array,
    weight: jax.Array,
    effort: jax.Array,
    low: jax.Array,
    high: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    step = make_step(problem, time_step)
    cost, effort_cost = jnp.diag(1.0 / weight**2), jnp.diag(1.0 / effort**2)
    slopes = jax.vmap(jax.jacfwd(step, argnums=(0, 1)))(states[:-1], commands)

    def riccati(value: jax.Array, slope: tuple) -> tuple[jax.Array, jax.Array]:
        a, b = slope
        gain = jnp.linalg.solve(effort_cost + b.T @ value @ b, b.T @ value @ a)
        value = cost + a.T @ value @ (a - b @ gain)
        return 0.5 * (value + value.T), gain

    gains = jax.lax.scan(riccati, cost, slopes, reverse=True)[1]

    def advance(state: jax.Array, row: tuple) -> tuple[jax.Array, tuple]:
        target, command, gain = row
        command = jnp.clip(command - gain @ (state - target), low, high)
        after = step(state, command)
        return after, (after, command)

    return jax.lax.scan(advance, states[0], (states[:-1], commands, gains))[1]
