"""Initial guesses: a simulated flight, divided at its gates, or the flight of a point mass."""

import threading
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.limits.problem import Problem, leaves
from quadjax.limits.simulation import crossings
from quadjax.limits.trajectory import Trajectory

FASTEST_RATES = 12.0  # rad/s, body rates of a guess at most
SLOW_YAW = 2.0  # rad/s, limit of the yaw rate below which a guess has none
FITTED = 3  # least-squares steps to the commands of a guess


def from_flight(
    problem: Problem,
    motion: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    actuators: np.ndarray,
    commands: np.ndarray,
    time_step: float,
    intervals: int,
) -> list[Trajectory]:
    """Guesses from a recorded flight from hover.

    Args:
        problem: the flight to be optimized.
        motion: position, m, velocity, m/s, Euler angles, rad, and body rates, rad/s, (steps, 3).
        actuators: (steps, actuators), as the model's state.
        commands: (steps, commands), each held for a time step.
        time_step: s.
        intervals: of a leg.

    Returns:
        For a periodic problem one guess for each whole lap but the first, the fastest first; for a
        start from hover one guess. Empty if the flight passed too few gates.
    """
    position, velocity, euler, rates = motion
    repeated = np.arange(50 * len(problem.order)) % problem.gate_count
    times, _ = crossings(problem, position, time_step, repeated, openings=True)
    legs = len(problem.order)
    if problem.start == "hover":
        begins = [0] if len(times) >= legs else []
        times = np.concatenate([[0.0], times])
    else:
        begins = list(range(problem.gate_count - 1, len(times) - legs, problem.gate_count))
        begins.sort(key=lambda begin: times[begin + legs] - times[begin])
    columns = [position, velocity, np.unwrap(euler, axis=0), rates, actuators, commands]
    table = np.concatenate(columns, axis=1)
    return [
        _cut(problem, times[begin : begin + legs + 1], table, time_step, intervals)
        for begin in begins
    ]


def _cut(
    problem: Problem, times: np.ndarray, table: np.ndarray, time_step: float, intervals: int
) -> Trajectory:
    """The part between the first and the last of the gates' times, each leg resampled."""
    nodes = np.concatenate(
        [np.linspace(a, b, intervals + 1)[:-1] for a, b in zip(times[:-1], times[1:], strict=True)]
        + [times[-1:]]
    )
    flown = np.arange(len(table)) * time_step
    rows = np.stack([np.interp(nodes, flown, column) for column in table.T], axis=1)
    ends = 3, 6, 9, 12, 12 + len(problem.actuator_leaves)
    *motion, actuators, commands = np.split(rows, ends, axis=1)
    return Trajectory(np.diff(times), _states(problem, motion, actuators), commands)


def _states(problem: Problem, motion: Sequence[np.ndarray], actuators: np.ndarray) -> np.ndarray:
    """States (nodes, leaves) without jumps of a quaternion's sign.

    Args:
        problem: the flight.
        motion: position, velocity, Euler angles and body rates, (nodes, 3) each.
        actuators: (nodes, actuators).
    """
    states = np.array([problem.hover_at(*row) for row in zip(*motion, strict=True)])
    states[:, problem.actuator_leaves] = actuators
    mask = problem.normalized
    if mask.any():
        same = np.sign(np.sum(states[1:, mask] * states[:-1, mask], axis=1))
        states[1:, mask] *= np.cumprod(np.where(same < 0.0, -1.0, 1.0))[:, None]
    return states


def from_point_mass(
    problem: Problem,
    intervals: int,
    speed: float,
    *,
    heading: bool = False,
    spread: float = 0.0,
    seed: int = 0,
    seconds: float = 60.0,
    stop: threading.Event | None = None,
) -> Trajectory:
    """A guess along the time-optimal flight of a point mass.

    Args:
        problem: the flight.
        intervals: of a leg.
        speed: m/s, mean of each leg of the spline that the point mass starts from.
        heading: the nose points along the velocity. Otherwise it turns without yaw rate where the
            attitude is a quaternion or the yaw rate has a limit, and has a constant direction
            elsewhere.
        spread: fraction of the opening within which random points replace the centers.
        seed: of these points, and of the constant direction.
        seconds: time limit.
        stop: if set, the solver ends.
    """
    from quadjax.limits.point_mass import optimize, spline

    rng = np.random.default_rng(seed)
    first = spline(problem, intervals, speed, spread, rng)
    with jax.enable_x64(True):  # as in simulations: functions of the model are compiled once
        path = optimize(problem, first, seconds, stop or threading.Event())
        constant = (
            _start_yaw(problem) if problem.start == "hover" else spread * rng.uniform(-3.0, 3.0)
        )
        yaw = np.full(len(path.position), constant)
        slow = problem.start == "hover" and problem.rate_limit[2] < SLOW_YAW
        transported = bool(slow or (problem.normalized.any() and not heading))
        if heading:
            yaw = np.unwrap(np.arctan2(path.velocity[:, 1], path.velocity[:, 0]))
        return from_path(
            problem, path.leg_times, path.position, path.velocity, path.force, yaw, transported
        )


def _start_yaw(problem: Problem) -> float:
    with jax.enable_x64(True):
        return float(problem.model.euler(problem.hover_state).z)


def from_path(
    problem: Problem,
    leg_times: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    force: np.ndarray,
    yaw: np.ndarray,
    transported: bool = False,
) -> Trajectory:
    """States and commands along a path: tilted along the force, with its thrust.

    Args:
        problem: the flight.
        leg_times: (legs,) s.
        position: (nodes, 3) m.
        velocity: (nodes, 3) m/s.
        force: (nodes, 3) m/s^2, world.
        yaw: (nodes,) rad, without jumps.
        transported: from the first yaw on without yaw rate.
    """
    steps = np.repeat(
        leg_times * len(leg_times) / (len(position) - 1), (len(position) - 1) // len(leg_times)
    )
    periodic = problem.start == "periodic"
    rotations = _transported(force, yaw[0], periodic) if transported else _attitudes(force, yaw)
    euler = np.unwrap(rotations.as_euler("ZYX"), axis=0)[:, ::-1]
    euler[:, 2] += 2.0 * np.pi * np.round((yaw[0] - euler[0, 2]) / (2.0 * np.pi))
    turned = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / steps[:, None]
    rates = np.clip(np.vstack([turned, turned[-1:]]), -FASTEST_RATES, FASTEST_RATES)
    rates = np.clip(rates, -0.9 * problem.rate_limit, 0.9 * problem.rate_limit)
    actuators = _actuators(problem, np.linalg.norm(force, axis=1))
    states = _states(problem, (position, velocity, euler, rates), actuators)
    if problem.start == "hover":
        states[0] = leaves(problem.hover_state)
    return Trajectory(leg_times, states, _commands(problem, states, steps))


def _attitudes(force: np.ndarray, yaw: np.ndarray) -> Rotation:
    """Body-to-world rotations (n,) whose thrust is along a force (n, 3), by yaw (n,)."""
    down = _down(force)
    nose = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    right = np.cross(down, nose)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-6)
    return Rotation.from_matrix(np.stack([np.cross(right, down), right, down], axis=2))


def _down(force: np.ndarray) -> np.ndarray:
    return -force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-6)


def _transported(force: np.ndarray, yaw: float, periodic: bool) -> Rotation:
    """Body-to-world rotations (n,) along a force (n, 3), each by the shortest turn.

    Of a periodic flight a constant turn about the thrust per node is added, so that the last
    rotation is the first.
    """
    down = _down(force)
    found = [_attitudes(force[:1], np.array([yaw]))[0]]
    for before, after in zip(down[:-1], down[1:], strict=True):
        axis = np.cross(before, after)
        sine = np.linalg.norm(axis)
        angle = np.arctan2(sine, before @ after)
        found.append(Rotation.from_rotvec(axis / max(sine, 1e-12) * angle) * found[-1])
    turn = (found[-1].inv() * found[0]).as_rotvec()[2] if periodic else 0.0
    share = np.linspace(0.0, turn, len(found))
    return Rotation.concatenate(found) * Rotation.from_rotvec(share[:, None] * [0.0, 0.0, 1.0])


def _actuators(problem: Problem, thrust: np.ndarray) -> np.ndarray:
    """Equal fractions of the actuators' ranges (n, actuators) that give a thrust (n,), m/s^2."""
    model, start = problem.model, problem.hover_at(*np.zeros((3, 3)))
    low, high = (leaves(end) for end in model.actuator_range(problem.vehicle.constants))
    shares = np.linspace(0.0, 1.0, 41)
    given = []
    for share in shares:
        start[problem.actuator_leaves] = low + share * (high - low)
        given.append(-problem.specific_force(start)[2])
    return low + np.interp(thrust, given, shares)[:, None] * (high - low)


def _commands(problem: Problem, states: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Commands (nodes, commands) whose derivatives fit the change of the states best."""
    low, high = problem.command_range
    scale = np.maximum(np.abs(states).max(axis=0), 1.0)
    wanted = np.diff(states, axis=0) / steps[:, None] / scale

    def slope(state: jax.Array, command: jax.Array) -> jax.Array:
        held = problem.command(command)
        full = problem.model.hold(problem.state(state), held)
        rows = jax.tree.leaves(problem.model.derivative(problem.vehicle, full, held))
        return jnp.stack([jnp.asarray(x) for x in rows]) / scale

    def fit(state: jax.Array, change: jax.Array) -> jax.Array:
        command = jnp.asarray(0.5 * (low + high))
        for _ in range(FITTED):
            jacobian = jax.jacfwd(slope, argnums=1)(state, command) * (high - low)
            wrong = change - slope(state, command)
            size = jnp.sum(jacobian**2) + 1e-12
            square = jacobian.T @ jacobian + 1e-4 * size * jnp.eye(len(low))
            move = jnp.linalg.solve(square, jacobian.T @ wrong)
            command = jnp.clip(command + (high - low) * move, low, high)
        return command

    with jax.enable_x64(True):
        pairs = map(jnp.asarray, (states[:-1], wanted))
        commands = np.asarray(jax.jit(jax.vmap(fit))(*pairs))
    return np.vstack([commands, commands[-1:]])
