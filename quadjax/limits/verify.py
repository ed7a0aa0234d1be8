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
from quadjax.limits.problem import ATTITUDE, POSITION, TIME_STEP_S, VELOCITY, Gates, Problem
from quadjax.limits.trajectory import Trajectory
from quadjax.race.environment import Race
from quadjax.race.rules import terminations_of
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.protocol import State

TIME_TOLERANCE = 0.005  # relative to the time of the solution
STEPS_MULTIPLE = 1000  # the number of steps is a multiple: each number is compiled separately
OVERRUN_FACTOR = 1.01  # the simulation is longer than the solution, to reach the last gate
AT_REST = 0.02, 0.05  # m from the center of the last gate, and m/s, at the end of a flight at rest
MAX_MISS_M = 0.05  # by which a rejected flight may miss a gate and continue, to measure all misses
# Of the regulator: m, m/s, and a fraction of the largest value of others.
STATE_TOLERANCES = 0.03, 0.1, 0.03
COMMAND_TOLERANCE = 0.1  # fraction of the range: tolerance of the commands


@dataclasses.dataclass(frozen=True)
class Check:
    """The result of flying a solution in the race."""

    error: str  # why the solution is rejected; "" if it is verified
    leg_times: np.ndarray  # (legs,) s, between the gates
    clearance: float  # m, smallest ``Problem.leeway`` of a passage; negative: a gate is missed
    margin: float  # m, smallest distance from the bounds and the ground; negative: outside
    rate_share: float  # largest body rate, relative to ``Problem.rate_limit``
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
    steps = STEPS_MULTIPLE * int(
        np.ceil(OVERRUN_FACTOR * trajectory.total / (STEPS_MULTIPLE * TIME_STEP_S))
    )
    states, commands = reference(problem, trajectory, steps)
    check = _check(problem, trajectory, commands, False)
    if not check.error:
        return check
    weight = STATE_TOLERANCES[2] * np.maximum(np.abs(trajectory.states).max(axis=0), 0.1)
    weight[POSITION], weight[VELOCITY] = STATE_TOLERANCES[:2]
    with jax.enable_x64(True):
        commands = np.asarray(_follow(problem, states, commands, weight))
    corrected = _check(problem, trajectory, commands, True)
    better = (bool(corrected.error), corrected.miss) < (bool(check.error), check.miss)
    return corrected if better else check


def reference(
    problem: Problem, trajectory: Trajectory, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, n) and commands (steps, commands) of a solution, every millisecond.

    Beyond the end: of a periodic flight its next round, of another one its last values.
    """
    when, total, periodic = np.arange(steps + 1) * TIME_STEP_S, trajectory.total, problem.periodic
    over = (when >= total) & periodic
    states = trajectory.curve(problem)(np.minimum(np.where(over, when - total, when), total))
    if trajectory.states[0, ATTITUDE] @ trajectory.states[-1, ATTITUDE] < 0.0:
        states[over, ATTITUDE] *= -1.0
    middle = when[:-1] + 0.5 * TIME_STEP_S
    middle = middle % total if periodic else np.minimum(middle, total)
    commands = [np.interp(middle, trajectory.times, column) for column in trajectory.commands.T]
    return states, np.stack(commands, axis=1)


def passages(
    gates: Gates, order: Iterable[int], position: np.ndarray, time_step: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """When and where a path passes gates, up to the first that it misses by a tolerance, m.

    Returns:
        The times (passages,), s, where straight lines between positions (n, 3), m, ``time_step`` s
        apart, cross the planes of the gates, and these places (passages, 3), m.
    """
    steps, places, step = [], [], 0
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
        steps.append(step + index + fraction)
        places.append(place)
        step += index + 1
    return np.array(steps) * time_step, np.array(places).reshape(-1, 3)


@functools.partial(jax.jit, static_argnames=("environment",))
def _fly(
    environment: Race, params: RaceParams, start: RaceState, actions: jax.Array
) -> tuple[jax.Array, ...]:
    """Position, velocity, body rates (steps + 1, 3), and numbers of broken rules (steps + 1,)."""

    def motion(drone: State) -> tuple[jax.Array, ...]:
        return drone.position.array(), drone.velocity.array(), drone.rates.array()

    def advance(state: RaceState, action: jax.Array) -> tuple[RaceState, tuple]:
        after, _, outcome = environment.transition(params, state, action)
        return after, (*motion(after.drone), outcome.crash_code)

    rows, first = jax.lax.scan(advance, start, actions)[1], (*motion(start.drone), 0)
    return jax.tree.map(lambda x, row: jnp.concatenate([jnp.asarray(x)[None], row]), first, rows)


def _check(problem: Problem, trajectory: Trajectory, commands: np.ndarray, feedback: bool) -> Check:
    """Fly commands in the race and measure the flight, up to the last gate.

    The drone continues after a broken rule, so that all misses are measured.
    """
    low, high = problem.command_range
    actions = 2.0 * (commands - low) / np.where(high > low, high - low, 1.0) - 1.0
    start = dataclasses.replace(problem.race_start, drone=problem.state(trajectory.states[0]))
    with jax.enable_x64(True):
        position, velocity, rates, crashes = map(
            np.asarray, _fly(problem.environment, problem.params, start, actions)
        )
    order = problem.order[: len(problem.order) - problem.flight.stops]
    times, places = passages(problem.gates, order, position, TIME_STEP_S, MAX_MISS_M)
    leeways = [problem.leeway(*pair) for pair in zip(order, places, strict=False)]
    if len(times) < len(order):
        leeways.append(-MAX_MISS_M)
    elif problem.flight.stops:
        times = np.append(times, trajectory.total)
    end = 1 + min(int(np.ceil(times.max(initial=0.0) / TIME_STEP_S)), len(commands))
    (lowest, highest), inside = problem.bounds, position[1:end]
    margin = np.concatenate([inside - lowest, highest - inside]).min(initial=np.inf)
    rate_share = float(np.max(np.abs(rates[:end]) / problem.rate_limit))
    legs, clearance, path = np.diff(times, prepend=0.0), min(leeways), position[:end]
    error, total = "", float(legs.sum())
    if clearance < 0.0:
        gate = problem.order[np.argmin(leeways)] + 1
        error = f"it misses gate {gate} by {-1e3 * clearance:.1f} mm"
    elif margin < 0.0:
        error = f"it leaves the bounds of the race by {-1e3 * margin:.1f} mm"
    elif crashes[:end].any():
        step = int(np.argmax(crashes > 0))
        reason = list(terminations_of(problem.environment.user_rules))[crashes[step] - 1]
        error = f"{reason} at {step * TIME_STEP_S:.3f} s"
    elif problem.flight.stops:
        error = _at_rest(problem, path[-1], velocity[end - 1])
    if not error and abs(total - trajectory.total) > TIME_TOLERANCE * trajectory.total:
        error = f"it takes {total:.3f} s instead of {trajectory.total:.3f} s"
    motion = path, velocity[:end], commands[: end - 1]
    return Check(error, legs, float(clearance), float(margin), rate_share, feedback, *motion)


def _at_rest(problem: Problem, position: np.ndarray, velocity: np.ndarray) -> str:
    away = np.linalg.norm(position - problem.gates.position[problem.order[-1]])
    speed = np.linalg.norm(velocity)
    if away <= AT_REST[0] and speed <= AT_REST[1]:
        return ""
    return f"it ends {away:.3f} m from the last gate at {speed:.2f} m/s"


@functools.partial(jax.jit, static_argnames=("problem",))
def _follow(
    problem: Problem, states: jax.Array, commands: jax.Array, weight: jax.Array
) -> jax.Array:
    """Commands (steps, commands) of a regulator that follows a reference, within their range."""
    low, high = problem.command_range
    cost = jnp.diag(1.0 / weight**2)
    effort = COMMAND_TOLERANCE * np.where(high > low, high - low, 1.0)
    effort_cost = jnp.diag(1.0 / effort**2)

    def step(state: jax.Array, command: jax.Array) -> jax.Array:
        after = rk4_loop_step(lambda x: problem.slope(x, command), state, TIME_STEP_S)
        return problem.vector(problem.state(after).wrapped())

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
