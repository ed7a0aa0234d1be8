"""Verification of a solution: its commands are flown in the race itself.

Each command is held for 1 ms, with RK4 in float64, by the step and the rules of the race. Where the
commands alone fail, a linear-quadratic regulator corrects them along the solution: errors of a mesh
grow with the length of the flight. The flight of the corrected commands is verified like any other.
"""

import dataclasses
import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.integrators import rk4_loop_step
from quadjax.limits.gates import Gates
from quadjax.limits.problem import ATTITUDE, POSITION, TIME_STEP, VELOCITY, Problem
from quadjax.limits.trajectory import Trajectory
from quadjax.race.environment import Choices, RaceParams, RaceState, transition

TIME_TOLERANCE = 0.005  # relative to the time of the solution
STEPS = 1000  # the number of steps is a multiple: each number is compiled anew
OVERRUN = 1.01  # the simulation is longer than the solution, to reach the last gate
AT_REST = 0.02, 0.05  # m from the center of the last gate, and m/s, at the end of a flight at rest
MISSED = 0.05  # m, by which a rejected flight may miss a gate and continue, to measure all misses
TOLERANCES = 0.03, 0.1, 0.03  # of the regulator: m, m/s, fraction of the largest value of others
COMMAND = 0.1  # fraction of the range: tolerance of the commands


@dataclasses.dataclass(frozen=True)
class Check:
    """The result of flying a solution in the race."""

    error: str  # why the solution is rejected; "" if it is verified
    leg_times: np.ndarray  # (legs,) s, between the gates
    clearance: float  # m, smallest ``Problem.leeway`` of a passage; negative: a gate is missed
    margin: float  # m, smallest distance from the bounds and the ground; negative: outside
    feedback: bool  # whether a regulator corrected the solution's commands
    position: np.ndarray  # (steps + 1, 3) m, world
    velocity: np.ndarray  # (steps + 1, 3) m/s, world
    commands: np.ndarray  # (steps, commands) that it flew

    @property
    def total(self) -> float:
        """Time of the flight, s."""
        return float(self.leg_times.sum())

    @property
    def miss(self) -> float:
        """By how much the flight leaves the openings and the bounds, m."""
        return max(0.0, -min(self.clearance, self.margin))

    @property
    def top_speed(self) -> float:
        """Highest speed, m/s."""
        return float(np.linalg.norm(self.velocity, axis=1).max())


def verify(problem: Problem, trajectory: Trajectory) -> Check:
    """Fly the commands of a solution; if they are rejected, also corrected by a regulator."""
    steps = STEPS * int(np.ceil(OVERRUN * trajectory.total / (STEPS * TIME_STEP)))
    states, commands = reference(problem, trajectory, steps)
    check = _check(problem, trajectory, commands, False)
    if not check.error:
        return check
    corrected = _check(problem, trajectory, _follow(problem, trajectory, states, commands), True)
    better = (bool(corrected.error), corrected.miss) < (bool(check.error), check.miss)
    return corrected if better else check


def reference(
    problem: Problem, trajectory: Trajectory, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, n) and commands (steps, commands) of a solution, every millisecond.

    Beyond the end: of a periodic flight its next round, of another one its last values.
    """
    when, total, periodic = np.arange(steps + 1) * TIME_STEP, trajectory.total, problem.periodic
    over = (when >= total) & periodic
    states = trajectory.curve(problem)(np.minimum(np.where(over, when - total, when), total))
    if trajectory.states[0, ATTITUDE] @ trajectory.states[-1, ATTITUDE] < 0.0:
        states[over, ATTITUDE] *= -1.0
    middle = when[:-1] + 0.5 * TIME_STEP
    middle = middle % total if periodic else np.minimum(middle, total)
    commands = [np.interp(middle, trajectory.times, column) for column in trajectory.commands.T]
    return states, np.stack(commands, axis=1)


def passages(
    gates: Gates, order: Iterable[int], position: np.ndarray, time_step: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """When and where a path passes gates, up to the first that it misses.

    Args:
        gates: of the track.
        order: indices of the gates.
        position: (n, 3) m.
        time_step: s, between them.
        tolerance: m, by which an edge of an opening may be missed.

    Returns:
        The times (passages,), s, where straight lines between the positions cross the planes of the
        gates, and these places (passages, 3), m.
    """
    times, places, step = [], [], 0
    for gate in order:
        ahead = (position[step:] - gates.position[gate]) @ gates.axes[gate, 0]
        (crossed,) = np.nonzero((ahead[:-1] < 0) & (ahead[1:] >= 0))
        if not len(crossed):
            break
        index = int(crossed[0])
        fraction = -ahead[index] / (ahead[index + 1] - ahead[index])
        before, after = position[step + index : step + index + 2]
        place = before + fraction * (after - before)
        if gates.clearance(gate, place) < -tolerance:
            break
        times.append((step + index + fraction) * time_step)
        places.append(place)
        step += index + 1
    return np.array(times), np.array(places).reshape(-1, 3)


@functools.partial(jax.jit, static_argnames=("choices",))
def _fly(
    choices: Choices, params: RaceParams, start: RaceState, actions: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position and velocity (steps, 3), and whether a rule is broken (steps,), of actions."""

    def advance(state: RaceState, action: jax.Array) -> tuple[RaceState, tuple]:
        after, _, outcome = transition(choices, params, state, action)
        place, speed = choices.model.position(after.drone), choices.model.velocity(after.drone)
        return after, (place.array(), speed.array(), outcome.terminated)

    return jax.lax.scan(advance, start, actions)[1]


def _check(problem: Problem, trajectory: Trajectory, commands: np.ndarray, feedback: bool) -> Check:
    """Fly commands in the race and measure the flight, up to the last gate.

    The drone continues after a broken rule, so that all misses are measured.
    """
    low, high = problem.command_range
    actions = 2.0 * (commands - low) / np.where(high > low, high - low, 1.0) - 1.0
    first = trajectory.states[0]
    state = dataclasses.replace(problem.race_start, drone=problem.state(first))
    with jax.enable_x64(True):
        rows = map(np.asarray, _fly(problem.choices, problem.params, state, actions))
    start = first[POSITION], first[VELOCITY], False
    position, velocity, broken = (
        np.concatenate([np.asarray(x)[None], row]) for x, row in zip(start, rows, strict=True)
    )
    order = problem.order[: len(problem.order) - problem.flight.stops]
    times, places = passages(problem.gates, order, position, TIME_STEP, MISSED)
    leeways = [problem.leeway(*pair) for pair in zip(order, places, strict=False)]
    if len(times) < len(order):
        leeways.append(-MISSED)
    elif problem.flight.stops:
        times = np.append(times, trajectory.total)
    last = min(int(np.ceil(times.max(initial=0.0) / TIME_STEP)), len(commands))
    inside, (lowest, highest) = position[1 : last + 1], problem.bounds
    margin = min((inside - lowest).min(initial=np.inf), (highest - inside).min(initial=np.inf))
    check = Check(
        error="",
        leg_times=np.diff(times, prepend=0.0),
        clearance=float(min(leeways)),
        margin=float(margin),
        feedback=feedback,
        position=position[: last + 1],
        velocity=velocity[: last + 1],
        commands=commands[:last],
    )
    error = _error(problem, trajectory, check, leeways, broken[: last + 1])
    return dataclasses.replace(check, error=error)


def _error(
    problem: Problem, trajectory: Trajectory, check: Check, leeways: list[float], broken: np.ndarray
) -> str:
    """Why a flight is rejected; "" if it is not."""
    if check.clearance < 0.0:
        gate = problem.order[np.argmin(leeways)] + 1
        return f"it misses gate {gate} by {-1e3 * check.clearance:.1f} mm"
    if check.margin < 0.0:
        return f"it leaves the bounds of the race by {-1e3 * check.margin:.1f} mm"
    if broken.any():
        return f"it breaks a rule of the race at {np.argmax(broken) * TIME_STEP:.3f} s"
    if problem.flight.stops:
        away = np.linalg.norm(check.position[-1] - problem.gates.position[problem.order[-1]])
        speed = np.linalg.norm(check.velocity[-1])
        if away > AT_REST[0] or speed > AT_REST[1]:
            return f"it ends {away:.3f} m from the last gate at {speed:.2f} m/s"
    if abs(check.total - trajectory.total) > TIME_TOLERANCE * trajectory.total:
        return f"it takes {check.total:.3f} s instead of {trajectory.total:.3f} s"
    return ""


def _follow(
    problem: Problem, trajectory: Trajectory, states: np.ndarray, commands: np.ndarray
) -> np.ndarray:
    """Commands (steps, commands) of a regulator that follows a reference, within their range."""
    low, high = problem.command_range
    weight = TOLERANCES[2] * np.maximum(np.abs(trajectory.states).max(axis=0), 0.1)
    weight[POSITION], weight[VELOCITY] = TOLERANCES[:2]
    effort = COMMAND * np.where(high > low, high - low, 1.0)
    with jax.enable_x64(True):
        return np.asarray(_regulate(problem, states, commands, weight, effort))


@functools.partial(jax.jit, static_argnames=("problem",))
def _regulate(
    problem: Problem, states: jax.Array, commands: jax.Array, weight: jax.Array, effort: jax.Array
) -> jax.Array:
    cost, effort_cost = jnp.diag(1.0 / weight**2), jnp.diag(1.0 / effort**2)
    low, high = problem.command_range

    def step(state: jax.Array, command: jax.Array) -> jax.Array:
        after = rk4_loop_step(lambda x: problem.slope(x, command), state, TIME_STEP)
        return problem.vector(problem.model.wrap(problem.state(after)))

    slopes = jax.vmap(jax.jacfwd(step, argnums=(0, 1)))(states[:-1], commands)

    def riccati(value: jax.Array, slope: tuple) -> tuple[jax.Array, jax.Array]:
        a, b = slope
        gain = jnp.linalg.solve(effort_cost + b.T @ value @ b, b.T @ value @ a)
        value = cost + a.T @ value @ (a - b @ gain)
        return 0.5 * (value + value.T), gain

    gains = jax.lax.scan(riccati, cost, slopes, reverse=True)[1]

    def advance(state: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        target, command, gain = row
        command = jnp.clip(command - gain @ (state - target), low, high)
        return step(state, command), command

    return jax.lax.scan(advance, states[0], (states[:-1], commands, gains))[1]
