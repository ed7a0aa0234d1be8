"""Initial guesses: a recorded flight, divided at its gates, or a spline through the gates."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.flights.flight import SIMULATED, recorded_flights
from quadjax.limits.problem import ACTUATORS, POSITION, Problem, to_euler
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.verify import passages
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.race import warn_of_other_race

INTERVALS = 20  # of a leg, on the first mesh
POLICY_LAPS = 4
MAX_RATES_RAD_S = 12.0  # body rates of a guess
SPEEDS_M_S = (8.0, 4.0, 6.0, 2.5)  # means along the splines
OPENING_FRACTION = 0.8  # of the openings, within which random points are
UPRIGHT = 0.15  # smallest vertical part of the force, where the pitch is limited


def policy_lap(problem: Problem, config: Config, policy: Path | str) -> Trajectory:
    """The fastest lap of a policy in a race, as a trajectory.

    Raises:
        InputError: the policy completes no lap.
    """
    network = Policy.load(policy, config)
    warn_of_other_race(network, config, policy)
    environment, params = make_race(config)
    laps = -(-len(problem.order) // len(problem.gates.position))
    count = POLICY_LAPS if problem.periodic else laps
    how: dict[str, Any] = {"laps": count, "runs": 1, "deterministic": True, "name": str(policy)}
    result, trace = pilot.fly_policy(environment, params, network, trace=True, **how)
    assert trace is not None
    time_step = float(params.rules.time_step)
    (flight,) = recorded_flights(trace, result, time_step, config.track.gates, environment.model)
    columns = [flight[name] for name in SIMULATED]
    recorded = from_flight(problem, columns, time_step)
    if not recorded:
        raise InputError(f"{policy}: no whole lap ({flight.crash or 'too few laps'})")
    return recorded[0]


def from_flight(
    problem: Problem, columns: Sequence[np.ndarray], time_step: float, intervals: int = INTERVALS
) -> list[Trajectory]:
    """Guesses from a recorded flight from hover.

    ``columns`` are the arrays (steps, n) of ``SIMULATED``: m, m/s, rad, rad/s, the actuators'
    state, and the commands, each held for a time step, s.

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


def from_spline(problem: Problem, index: int = 0, intervals: int = INTERVALS) -> Trajectory:
    """A guess along a spline through the gates, with the thrust along the force that it needs.

    The actuators are those of a hover. The nose of the second and of every other guess is along the
    velocity. All but the first two go through random points of the openings.
    """
    gates, order, speed = problem.gates, problem.order, SPEEDS_M_S[index % len(SPEEDS_M_S)]
    sides = np.random.default_rng(index).uniform(-1.0, 1.0, gates.half_size.shape)
    sides = OPENING_FRACTION * (index > 1) * sides * gates.half_size
    points = gates.position + np.einsum("gs,gsi->gi", sides, gates.axes[:, 1:])
    points = points[np.concatenate([order[-1:], order])]
    if not problem.periodic:
        points[0] = problem.start[POSITION]
    lengths = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    times = np.concatenate([[0.0], np.cumsum(lengths / speed)])
    rest, free = (1, np.zeros(3)), (2, np.zeros(3))
    ends = "periodic" if problem.periodic else (rest, rest if problem.flight.stops else free)
    curve = CubicSpline(times, points, bc_type=ends)
    legs = np.arange(len(order) * intervals + 1) / intervals
    nodes = np.interp(legs, np.arange(len(times)), times)
    rotations = _attitudes(problem, curve(nodes, 1), curve(nodes, 2), index % 2 == 1)
    turned = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / np.diff(nodes)[:, None]
    fastest = np.minimum(MAX_RATES_RAD_S, 0.9 * problem.rate_limit)
    rates = np.clip(np.vstack([turned, turned[-1:]]), -fastest, fastest)
    motion = curve(nodes), curve(nodes, 1), rotations.as_euler("ZYX")[:, ::-1], rates
    states = problem.vectors(motion, np.tile(problem.start[ACTUATORS], (len(nodes), 1)))
    if not problem.periodic:
        states[0] = problem.start
    middle = np.mean(problem.command_range, axis=0)
    return Trajectory(np.diff(times), states, np.tile(middle, (len(nodes), 1)))


def _attitudes(
    problem: Problem, velocity: np.ndarray, acceleration: np.ndarray, along: bool
) -> Rotation:
    """Body-to-world rotations (n,) with the thrust along the force that an acceleration needs.

    With ``along`` the nose is along the velocity. Otherwise each attitude follows from the one
    before by the shortest turn, up to a constant yaw rate that closes a periodic flight.
    """
    axis = np.array([0.0, 0.0, 1.0])
    down = float(problem.params.vehicle.constants.g) * axis - acceleration
    if math.isfinite(problem.pitch_limit):
        down[:, 2] = np.maximum(down[:, 2], UPRIGHT * np.linalg.norm(down, axis=1))
    pairs = zip(down, [axis, *down[:-1]], strict=True)
    turns = [Rotation.align_vectors(*pair)[0] for pair in pairs]
    attitudes = list(itertools.accumulate(turns, lambda attitude, turn: turn * attitude))
    yaw = 0.0 if problem.periodic else float(to_euler(problem.start[None])[0, 2])
    levels = Rotation.concatenate(attitudes) * Rotation.from_rotvec(yaw * axis)
    angle = np.zeros(len(down))
    if along:
        forward, right, _ = levels.inv().apply(velocity).T
        angle = np.unwrap(np.arctan2(right, forward))
    elif problem.periodic:
        angle = np.linspace(0.0, (levels[-1].inv() * levels[0]).as_rotvec()[2], len(down))
    return levels * Rotation.from_rotvec(angle[:, None] * axis)
