"""Initial guesses: a simulated flight, divided at its gates, or a spline through the gates."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from quadjax.core.integrators import INTEGRATORS
from quadjax.limits.collocation import Trajectory
from quadjax.limits.problem import Problem, leaves

GRAVITY = 9.81  # m/s^2, for the attitude of a guess only
STEEPEST = math.radians(75.0)  # largest tilt of a guess


def from_flight(
    problem: Problem, commands: np.ndarray, time_step: float, integrator: str, intervals: int
) -> list[Trajectory]:
    """Guesses from a flight of the model, by its commands from hover.

    Args:
        problem: the flight to be optimized.
        commands: (steps, commands) each held for a time step.
        time_step: s.
        integrator: of the environment, ``euler`` or ``rk4``.
        intervals: of a leg.

    Returns:
        For a periodic problem one guess for each whole lap but the first, the fastest first; for a
        start from hover one guess. None if the flight passed too few gates.
    """
    states = simulate(problem, commands, time_step, integrator)
    times, _ = crossings(problem, states, time_step, np.tile(problem.order, 50))
    legs = len(problem.order)
    if problem.start == "hover":
        begins = [0] if len(times) >= legs else []
        times = np.concatenate([[0.0], times])
    else:
        begins = list(range(problem.gate_count - 1, len(times) - legs, problem.gate_count))
        begins.sort(key=lambda begin: times[begin + legs] - times[begin])
    flown = np.arange(len(states)) * time_step
    return [
        _cut(times[begin : begin + legs + 1], flown, states, commands, intervals)
        for begin in begins
    ]


def _cut(
    times: np.ndarray, flown: np.ndarray, states: np.ndarray, commands: np.ndarray, intervals: int
) -> Trajectory:
    """The part between the first and the last of the gates' times, each leg resampled."""
    nodes = np.concatenate(
        [np.linspace(a, b, intervals + 1)[:-1] for a, b in zip(times[:-1], times[1:], strict=True)]
        + [times[-1:]]
    )
    table = np.concatenate([states, np.vstack([commands, commands[-1:]])], axis=1)
    rows = np.stack([np.interp(nodes, flown, column) for column in table.T], axis=1)
    return Trajectory(np.diff(times), *np.split(rows, [states.shape[1]], axis=1))


@functools.partial(jax.jit, static_argnames=("problem", "integrator"))
def _simulate(
    problem: Problem,
    first: jax.Array,
    commands: jax.Array,
    time_step: float,
    integrator: str,
    quaternion: np.ndarray,
) -> jax.Array:
    def advance(state: jax.Array, command: jax.Array) -> tuple[jax.Array, jax.Array]:
        held = problem.command(command)
        after = INTEGRATORS[integrator](
            lambda drone: problem.model.derivative(problem.vehicle, drone, held),
            problem.model.hold(problem.state(state), held),
            time_step,
        )
        kept, wrapped = (jnp.stack(jax.tree.leaves(x)) for x in (after, problem.model.wrap(after)))
        row = jnp.where(quaternion, wrapped, kept)
        return row, row

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
        rows = _simulate(
            problem,
            jnp.asarray(first),
            jnp.asarray(commands),
            time_step,
            integrator,
            problem.normalized,
        )
        return np.concatenate([first[None], np.asarray(rows)])


def positions(problem: Problem, states: np.ndarray) -> np.ndarray:
    """Positions (n, 3), m, of state leaves (n, leaves)."""
    return _vectors(problem, states, "position")


def velocities(problem: Problem, states: np.ndarray) -> np.ndarray:
    """Velocities (n, 3), m/s, of state leaves (n, leaves)."""
    return _vectors(problem, states, "velocity")


def _vectors(problem: Problem, states: np.ndarray, name: str) -> np.ndarray:
    with jax.enable_x64(True):
        vector = getattr(problem.model, name)(problem.state(jnp.asarray(states).T))
        parts = [np.broadcast_to(np.asarray(x), len(states)) for x in vector.components()]
    return np.stack(parts, axis=1)


def crossings(
    problem: Problem,
    states: np.ndarray,
    time_step: float,
    order: np.ndarray,
    tolerance: float = 0.0,
) -> tuple[np.ndarray, float]:
    """When a flight passes its gates, missing none by more than ``tolerance``, m.

    Returns:
        The times (gates passed,), s, where straight lines between the samples cross the planes, and
        the smallest distance from an edge, m, negative where a gate was missed; times end there.
    """
    flown = positions(problem, states)
    times: list[float] = []
    clearance = np.inf
    step = 0
    for gate in order:
        ahead = (flown - problem.gates.position[gate]) @ problem.gates.through[gate]
        (found,) = np.nonzero((ahead[step:-1] < 0) & (ahead[step + 1 :] >= 0))
        if not len(found):
            break
        step += int(found[0])
        fraction = -ahead[step] / (ahead[step + 1] - ahead[step])
        place = flown[step] + fraction * (flown[step + 1] - flown[step])
        clearance = min(clearance, _clearance(problem, gate, place))
        if clearance < -tolerance:
            break
        times.append((step + fraction) * time_step)
        step += 1
        if step + 1 >= len(flown):
            break
    return np.array(times), clearance


def _clearance(problem: Problem, gate: int, place: np.ndarray) -> float:
    """Distance of a place in the gate's plane from the nearest edge, m; negative outside."""
    offset = place - problem.gates.position[gate]
    width, height = problem.gates.half_size[gate]
    lateral = np.abs(problem.gates.right[gate] @ offset)
    if problem.gates.world_box:
        lateral = np.abs(offset[:2]).max()
    return float(min(width - lateral, height - np.abs(offset[2])))


def from_spline(
    problem: Problem, intervals: int, speed: float, spread: float = 0.0, seed: int = 0
) -> Trajectory:
    """A guess along a cubic spline through the gates, tilted as its acceleration requires.

    Args:
        problem: the flight.
        intervals: of a leg.
        speed: m/s, mean of each leg.
        spread: fraction of the opening within which random points replace the centers.
        seed: of these points, and of the yaw.
    """
    rng = np.random.default_rng(seed)
    gates, order = problem.gates, problem.order
    sides = spread * rng.uniform(-1.0, 1.0, (problem.gate_count, 2)) * gates.half_size
    across = sides[:, :1] * gates.right + sides[:, 1:] * np.array([0.0, 0.0, 1.0])
    points = (gates.position + across)[np.concatenate([[problem.gate_count - 1], order])]
    periodic = problem.start == "periodic"
    if not periodic:
        points[0] = positions(problem, leaves(problem.hover_state)[None])[0]
    lengths = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    times = np.concatenate([[0.0], np.cumsum(lengths / speed)])
    ends = "periodic" if periodic else ((1, np.zeros(3)), "not-a-knot")
    if periodic:
        points[-1] = points[0]
    curve = CubicSpline(times, points, bc_type=ends)
    nodes = np.interp(
        np.arange(len(order) * intervals + 1) / intervals, np.arange(len(times)), times
    )
    heading = _heading(curve(nodes, 1), rng, spread)
    attitudes = _attitudes(curve(nodes, 2), heading)
    motions = zip(curve(nodes), curve(nodes, 1), attitudes, strict=True)
    states = np.array([problem.hover_at(*motion) for motion in motions])
    low, high = problem.command_range
    hovering = np.clip(_hover_command(problem, states[0]), low, high)
    return Trajectory(np.diff(times), states, np.tile(hovering, (len(nodes), 1)))


def _heading(velocity: np.ndarray, rng: np.random.Generator, spread: float) -> np.ndarray:
    """Yaw (n,), rad: along the velocity, or constant and random."""
    if spread and rng.uniform() < 0.5:
        return np.full(len(velocity), rng.uniform(-np.pi, np.pi))
    return np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))


def _attitudes(acceleration: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (n, 3) at which thrust gives an acceleration, m/s^2, as far as allowed."""
    up = -(acceleration - np.array([0.0, 0.0, GRAVITY]))  # body z, world
    up[:, 2] = np.maximum(up[:, 2], 0.3 * GRAVITY)
    forward = np.cos(yaw) * up[:, 0] + np.sin(yaw) * up[:, 1]
    right = -np.sin(yaw) * up[:, 0] + np.cos(yaw) * up[:, 1]
    pitch = np.clip(np.arctan2(forward, up[:, 2]), -STEEPEST, STEEPEST)
    roll = np.arctan2(-right * np.cos(pitch), up[:, 2])
    return np.stack([np.clip(roll, -STEEPEST, STEEPEST), pitch, yaw], axis=1)


def _hover_command(problem: Problem, state: np.ndarray) -> np.ndarray:
    """The middle of the command range, or where the actuators of a hover are."""
    low, high = problem.command_range
    actuators = np.array(
        [float(x) for x in jax.tree.leaves(problem.model.actuator_state(problem.state(state)))]
    )
    command = 0.5 * (low + high)
    if len(actuators) == len(command):
        return actuators
    command[len(command) - len(actuators) :] = actuators
    return command
