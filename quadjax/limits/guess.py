"""Initial guesses: a recorded flight, divided at its gates, or the flight of a point mass."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.limits.point_mass import Path, optimize, spline
from quadjax.limits.problem import ACTUATORS, Problem, euler_of
from quadjax.limits.program import Effort
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.verify import passages
from quadjax.race.environment import Choices, RaceParams

if TYPE_CHECKING:
    from quadjax.policy.file import Policy

INTERVALS = 20  # of a leg, on the first mesh
POLICY_LAPS = 4
RECORDED = ("position", "velocity", "euler", "rates", "actuators", "command")  # of a flight
FASTEST_RATES = 12.0  # rad/s, body rates of a guess at most
SPEEDS = (4.0, 8.0, 2.5, 6.0)  # m/s, of the splines that flights of point masses start from
FIT_STEPS = 3  # least-squares steps to the commands of a guess


def policy_laps(
    problem: Problem, choices: Choices, params: RaceParams, policy: "Policy", name: str
) -> list[Trajectory]:
    """Laps of a policy in a race as trajectories, the fastest first.

    Raises:
        InputError: the policy completes no lap.
    """
    from quadjax.policy import pilot

    laps = (
        POLICY_LAPS if problem.periodic else -(-len(problem.order) // len(problem.gates.position))
    )
    result, trace = pilot.fly_policy(
        choices, params, policy, laps=laps, runs=1, deterministic=True, trace=True, name=name
    )
    assert trace is not None
    time_step = float(params.rules.time_step)
    steps = round(float(result.seconds[0]) / time_step)
    columns = [np.asarray(getattr(trace, x), np.float64)[:steps, :, 0] for x in RECORDED]
    recorded = from_flight(problem, columns, time_step)
    if not recorded:
        raise InputError(f"{name}: no whole lap to compare ({result.crashes[0] or 'too few laps'})")
    return recorded


def from_flight(
    problem: Problem, columns: Sequence[np.ndarray], time_step: float, intervals: int = INTERVALS
) -> list[Trajectory]:
    """Guesses from a recorded flight from hover.

    Args:
        problem: the flight to be optimized.
        columns: the arrays (steps, n) of ``RECORDED``: m, m/s, rad, rad/s, the actuators' state,
            and the commands, each held for a time step.
        time_step: s.
        intervals: of a leg.

    Returns:
        For a periodic problem one guess for each whole lap but the first, the fastest first; for a
        start from hover one guess. Empty if the flight passed too few gates.
    """
    *motion, actuators, commands = columns
    endless = itertools.cycle(range(len(problem.gates.position)))
    times, _ = passages(problem.gates, endless, motion[0], time_step, 0.0)
    legs, count = len(problem.order), len(problem.gates.position)
    if not problem.periodic:
        starts = [0] if len(times) >= legs else []
        times = np.concatenate([[0.0], times])
    else:
        starts = list(range(count - 1, len(times) - legs, count))
        starts.sort(key=lambda index: times[index + legs] - times[index])
    table = np.concatenate([problem.vectors(motion, actuators), commands], axis=1)
    laps = []
    for index in starts:
        ends = times[index : index + legs + 1]
        nodes = np.interp(np.arange(legs * intervals + 1) / intervals, np.arange(legs + 1), ends)
        when = np.arange(len(table)) * time_step
        rows = np.stack([np.interp(nodes, when, column) for column in table.T], axis=1)
        states, held = np.split(rows, [len(problem.start)], axis=1)
        laps.append(Trajectory(np.diff(ends), states, held))
    return laps


def from_point_mass(
    problem: Problem, index: int = 0, effort: Effort | None = None, intervals: int = INTERVALS
) -> Trajectory:
    """A guess along the time-optimal flight of a point mass.

    The nose of the second and of every other guess is along the velocity. All but the first two
    start from a spline through random points of the openings.
    """
    first = spline(problem, intervals, SPEEDS[index % len(SPEEDS)], max(index - 1, 0))
    return from_path(problem, optimize(problem, first, effort or Effort()), index % 2 == 1)


def from_path(problem: Problem, path: Path, along: bool = False) -> Trajectory:
    """States and commands along a path: tilted along the force, with its thrust.

    Args:
        problem: the flight.
        path: of a point mass.
        along: whether the nose is along the velocity; otherwise each attitude follows from the one
            before by the shortest turn, up to a constant yaw rate that closes a periodic flight.
    """
    intervals = (len(path.position) - 1) // len(path.leg_times)
    steps = np.repeat(path.leg_times / intervals, intervals)
    rotations = _attitudes(problem, path, along)
    turned = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / steps[:, None]
    fastest = np.minimum(FASTEST_RATES, 0.9 * problem.rate_limit)
    rates = np.clip(np.vstack([turned, turned[-1:]]), -fastest, fastest)
    actuators = _actuators(problem, np.linalg.norm(path.force, axis=1))
    euler = rotations.as_euler("ZYX")[:, ::-1]
    states = problem.vectors((path.position, path.velocity, euler, rates), actuators)
    if not problem.periodic:
        states[0] = problem.start
    return Trajectory(path.leg_times, states, _commands(problem, states, steps))


def _attitudes(problem: Problem, path: Path, along: bool) -> Rotation:
    """Body-to-world rotations (n,) with the thrust along the force; see ``from_path``."""
    down, axis = -path.force, np.array([0.0, 0.0, 1.0])
    yaw = 0.0 if problem.periodic else float(euler_of(problem.start[None])[0, 2])
    turns = [
        Rotation.align_vectors(*pair)[0] for pair in zip(down, [axis, *down[:-1]], strict=True)
    ]
    attitudes = list(itertools.accumulate(turns, lambda attitude, turn: turn * attitude))
    levels = Rotation.concatenate(attitudes) * Rotation.from_rotvec(yaw * axis)
    angle = np.zeros(len(down))
    if along:
        forward, right, _ = levels.inv().apply(path.velocity).T
        angle = np.unwrap(np.arctan2(right, forward))
    elif problem.periodic:
        angle = np.linspace(0.0, (levels[-1].inv() * levels[0]).as_rotvec()[2], len(down))
    return levels * Rotation.from_rotvec(angle[:, None] * axis)


def _actuators(problem: Problem, thrust: np.ndarray) -> np.ndarray:
    """Equal fractions of the actuators' ranges (n, actuators) that give a thrust (n,), m/s^2."""
    (low, high), fractions = problem.actuator_range, np.linspace(0.0, 1.0, 41)
    state, thrusts = problem.level.copy(), []
    for fraction in fractions:
        state[ACTUATORS] = low + fraction * (high - low)
        thrusts.append(-problem.specific_force(state)[2])
    return low + np.interp(thrust, thrusts, fractions)[:, None] * (high - low)


def _commands(problem: Problem, states: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Commands (nodes, commands) whose derivatives fit the change of the states best."""
    low, high = problem.command_range
    scale = np.maximum(np.abs(states).max(axis=0), 1.0)
    changes = np.diff(states, axis=0) / steps[:, None] / scale

    def fit(state: jax.Array, change: jax.Array) -> jax.Array:
        slope = lambda command: problem.slope(state, command) / scale  # noqa: E731
        command = jnp.asarray(0.5 * (low + high))
        for _ in range(FIT_STEPS):
            jacobian = jax.jacfwd(slope)(command) * (high - low)
            size = jnp.sum(jacobian**2) + 1e-12
            square = jacobian.T @ jacobian + 1e-4 * size * jnp.eye(len(low))
            move = jnp.linalg.solve(square, jacobian.T @ (change - slope(command)))
            command = jnp.clip(command + (high - low) * move, low, high)
        return command

    with jax.enable_x64(True):
        commands = np.asarray(jax.jit(jax.vmap(fit))(states[:-1], changes))
    return np.vstack([commands, commands[-1:]])
