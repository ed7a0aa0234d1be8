"""Results as JSON and as arrays."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pydantic

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz, write_npz
from quadjax.core.provenance import provenance
from quadjax.limits.best_known import BestKnown, Unverified
from quadjax.limits.bound import LowerBound
from quadjax.limits.compare import Comparison
from quadjax.limits.problem import Problem
from quadjax.limits.simulation import positions, vectors, velocities
from quadjax.limits.trajectory import Trajectory
from quadjax.race.recorded_starts import LIMIT


def read_guess(problem: Problem, path: str) -> Trajectory:
    """The flight in an ``.npz`` file of ``arrays``, as an initial guess.

    Raises:
        InputError: the file cannot be read, or its flight is not through these gates.
    """
    names = ("state", "command", "leg_times")
    found, _ = read_npz(path, LIMIT, names)
    low, _ = problem.command_range
    legs, nodes = len(problem.order), len(found.get("state", ()))
    wanted = {"state": (nodes, len(problem.normalized)), "command": (nodes, len(low))}
    wanted["leg_times"] = (legs,)
    for name, shape in wanted.items():
        own = found[name].shape if name in found else None
        if own != shape or nodes < 2 or (nodes - 1) % legs:
            raise InputError(f"{path}: {name} has the shape {own}, expected {shape}, {legs} legs")
        if not np.isfinite(found[name]).all() or (found["leg_times"] <= 0.0).any():
            raise InputError(f"{path}: {name} is not finite, or a leg's time is not above 0")
    return Trajectory(found["leg_times"], found["state"], found["command"])


def write_flight(
    path: str | Path,
    vehicle: str,
    gates: Sequence[pydantic.BaseModel],
    problem: Problem,
    best: BestKnown,
    report: dict[str, Any] | None = None,
) -> None:
    """Write a verified flight as an ``.npz`` file, with the entries of a report in ``meta``."""
    track = [gate.model_dump(mode="json") for gate in gates]
    meta = {"format": LIMIT, "vehicle": vehicle, "track": track}
    meta["start"] = problem.start
    write_npz(path, arrays(problem, best), (report or {}) | meta)


def write_unverified(path: str | Path, found: Unverified) -> None:
    """Write a solution that is not verified as an ``.npz`` file for ``read_guess``."""
    flight = found.trajectory
    names = {"state": flight.states, "command": flight.commands, "leg_times": flight.leg_times}
    write_npz(path, names, {"format": LIMIT, "not_verified": found.error})


def to_json(
    config: pydantic.BaseModel,
    problem: Problem,
    best: BestKnown,
    bound: LowerBound | str,
    flown: Comparison | None,
    policy: str | None,
) -> dict[str, Any]:
    """The result, with the settings that it was computed with."""
    check, proven = best.check, isinstance(bound, LowerBound)
    return {
        "best_known": best.total,
        "lower_bound": bound.time if isinstance(bound, LowerBound) else None,
        "lower_bound_below_speed": bound.mass.speed if isinstance(bound, LowerBound) else None,
        "lower_bound_error": None if proven else bound,
        "leg_times": check.leg_times.tolist(),
        "top_speed": check.top_speed,
        "clearance": check.clearance,
        "closure": check.closure,
        "mesh_change": best.mesh_change if np.isfinite(best.mesh_change) else None,
        "intervals": best.trajectory.intervals,
        "guess": best.guess,
        "attempts": [dataclasses.asdict(each) for each in best.attempts],
        "notes": list(best.notes),
        "seconds": best.seconds,
        "gates": problem.passages,
        "start": problem.start,
        "stops": problem.stops,
        "feedback": check.feedback,
        "required_clearance": problem.clearance,
        "speed_limit": problem.speed_limit,
        "policy": flown
        and {
            "leg_times": flown.flown.tolist(),
            "gap": flown.gap,
            "lost_per_meter": flown.lost_per_meter.tolist(),
        },
        "provenance": provenance(config, policy),
    }


def arrays(problem: Problem, best: BestKnown) -> dict[str, np.ndarray]:
    """Times, states and commands at the nodes of the mesh.

    ``time`` (n,) s; ``position``, ``velocity`` (n, 3) m, m/s, world NED; ``euler``, ``rates``
    (n, 3) rad, rad/s; ``actuators`` (n, actuators); ``state`` (n, k), the leaves of the model's
    state in order; ``command`` (n, commands); ``leg_times`` (legs,) s;
    ``flown_position`` (m + 1, 3) and ``flown_command`` (m, commands), of the verification, each
    command held for 1 ms.
    """
    trajectory = best.trajectory
    with jax.enable_x64(True):
        state = problem.state(jnp.asarray(trajectory.states).T)
        actuators = [np.asarray(x) for x in jax.tree.leaves(problem.model.actuator_state(state))]
    return {
        "time": trajectory.times,
        "position": positions(problem, trajectory.states),
        "velocity": velocities(problem, trajectory.states),
        "euler": vectors(problem, trajectory.states, "euler"),
        "rates": vectors(problem, trajectory.states, "rates"),
        "actuators": np.stack(actuators, axis=1),
        "state": trajectory.states,
        "command": trajectory.commands,
        "leg_times": trajectory.leg_times,
        "flown_position": positions(problem, best.check.states),
        "flown_command": best.check.commands,
    }
