"""Results of a search as text, as JSON, and as a file of the flight."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz, write_npz
from quadjax.core.provenance import provenance
from quadjax.limits.bound import LowerBound
from quadjax.limits.compare import compare
from quadjax.limits.problem import (
    ACTUATORS,
    POSITION,
    RATES,
    TIME_STEP,
    VELOCITY,
    Problem,
    euler_of,
)
from quadjax.limits.search import MESH_CHANGE, BestKnown, NotFoundError
from quadjax.limits.trajectory import Trajectory
from quadjax.race.recorded_starts import LIMIT

if TYPE_CHECKING:
    from quadjax.config.schema import Config

ARRAYS = ("position", "velocity", "euler", "rates", "actuators", "command", "leg_times")


def read_guess(problem: Problem, path: str) -> Trajectory:
    """The flight in an ``.npz`` file of ``write_flight``, as an initial guess.

    Raises:
        InputError: the file cannot be read, or its flight is not through these gates.
    """
    arrays, _ = read_npz(path, LIMIT, ARRAYS)
    legs, nodes = len(problem.order), len(arrays.get("position", ()))
    sizes = 3, 3, 3, 3, len(problem.start) - 13, len(problem.command_range[0])
    shapes = {name: (nodes, size) for name, size in zip(ARRAYS, sizes, strict=False)}
    for name, shape in (shapes | {"leg_times": (legs,)}).items():
        actual = arrays[name].shape if name in arrays else None
        if actual != shape or nodes < 2 or (nodes - 1) % legs:
            raise InputError(
                f"{path}: {name} has the shape {actual}, expected {shape}, {legs} legs"
            )
        if not np.isfinite(arrays[name]).all() or (arrays["leg_times"] <= 0.0).any():
            raise InputError(f"{path}: {name} is not finite, or a leg's time is not above 0")
    *motion, actuators, commands, leg_times = (arrays[name] for name in ARRAYS)
    return Trajectory(leg_times, problem.vectors(motion, actuators), commands)


def write_flight(
    path: str | Path, config: "Config", problem: Problem, best: BestKnown, report: dict[str, Any]
) -> None:
    """Write a verified flight as an ``.npz`` file, with the entries of a report in ``meta``.

    Its arrays: ``time`` (n,) s, of the nodes of the mesh; ``position``, ``velocity`` (n, 3) m, m/s,
    world NED; ``euler``, ``rates`` (n, 3) rad, rad/s; ``actuators`` (n, actuators); ``command``
    (n, commands); ``leg_times`` (legs,) s; ``flown_position`` (m + 1, 3) and ``flown_command``
    (m, commands), of the verification, each command held for 1 ms.
    """
    arrays = _arrays(best.trajectory)
    flown = {"flown_position": best.check.position, "flown_command": best.check.commands}
    track = [gate.model_dump(mode="json") for gate in config.track.gates]
    start = "periodic" if problem.periodic else "hover"
    meta = {"format": LIMIT, "vehicle": config.vehicle.model, "track": track, "start": start}
    write_npz(path, arrays | flown, report | meta)


def write_unverified(path: str | Path, error: NotFoundError) -> bool:
    """Write the last solution of a search that found nothing, for ``read_guess``, if it has one."""
    if error.flight is not None:
        write_npz(path, _arrays(error.flight), {"format": LIMIT, "not_verified": error.error})
    return error.flight is not None


def _arrays(flight: Trajectory) -> dict[str, np.ndarray]:
    states = flight.states
    motion = states[:, POSITION], states[:, VELOCITY], euler_of(states), states[:, RATES]
    values = *motion, states[:, ACTUATORS], flight.commands, flight.leg_times
    return {"time": flight.times, **dict(zip(ARRAYS, values, strict=True))}


def to_json(
    config: "Config",
    problem: Problem,
    best: BestKnown,
    bound: LowerBound,
    policy: Trajectory | None,
    policy_path: str | None,
) -> dict[str, Any]:
    """The result, with the settings that it was computed with."""
    check, compared = best.check, None
    if policy is not None:
        result = compare(best.trajectory, policy)
        compared = {"leg_times": result.flown.tolist(), "gap": result.gap}
        compared["lost_per_meter"] = result.lost_per_meter.tolist()
    return {
        "best_known": best.total,
        "lower_bound": bound.time,
        "lower_bound_below_speed": bound.speed,
        "lower_bound_error": bound.error or None,
        "leg_times": check.leg_times.tolist(),
        "top_speed": check.top_speed,
        "clearance": check.clearance,
        "closure": float(np.linalg.norm(check.position[-1] - check.position[0])),
        "feedback": check.feedback,
        "mesh_change": best.mesh_change if np.isfinite(best.mesh_change) else None,
        "intervals": best.trajectory.intervals,
        "guess": best.guess,
        "attempts": dict(best.attempts),
        "seconds": best.seconds,
        "notes": notes_on(problem, best),
        "start": "periodic" if problem.periodic else "hover",
        "gates": len(problem.order),
        "speed_limit": problem.speed_limit,
        "flight": dataclasses.asdict(problem.flight),
        "policy": compared,
        "provenance": provenance(config, policy_path),
    }


def notes_on(problem: Problem, best: BestKnown) -> list[str]:
    """Remarks on a result, one sentence each."""
    notes, fitted = [], problem.flight.fitted_speed or np.inf
    if best.check.top_speed > 0.99 * problem.speed_limit:
        notes.append(
            f"the flight reaches the speed limit of {problem.speed_limit:g} m/s; the "
            "vehicle model may not hold there"
        )
    above = TIME_STEP * np.sum(np.linalg.norm(best.check.velocity, axis=1) > fitted)
    if above > 0.0:
        notes.append(
            f"for {above:.2f} s the flight is faster than {fitted:g} m/s, the highest speed of "
            "the flights that the model is fitted to"
        )
    if best.mesh_change > MESH_CHANGE:
        notes.append("the mesh was not refined until the time converged")
    return notes


def summary(
    problem: Problem,
    best: BestKnown,
    bound: LowerBound,
    policy: Trajectory | None = None,
    name: str | None = None,
) -> str:
    """The result in a few lines of text; ``name`` is that of the policy whose flight is given."""
    lines = [
        f"best known: {best.total:.4f} s, top speed {best.check.top_speed:.1f} m/s, from the "
        f"{best.guess} ({best.seconds:.0f} s of computing)"
    ]
    if bound.time is None:
        lines.append(f"lower bound: none ({bound.error})")
    else:
        lines.append(
            f"lower bound: {bound.time:.4f} s, up to rounding, for flights below {bound.speed:.1f} "
            f"m/s; the bracket is {100.0 * (best.total - bound.time) / best.total:.1f}% wide"
        )
    if policy is not None:
        result = compare(best.trajectory, policy)
        lines += [
            f"{name}: {policy.total:.4f} s, {100 * result.gap:.1f}% above best known",
            f"{'leg':>5} {'best known':>11} {'policy':>8} {'lost':>8} {'lost per meter':>15}",
        ]
        rows = zip(result.best, result.flown, result.lost_per_meter, strict=True)
        lines += [
            f"{leg:>5} {ours:>9.3f} s {theirs:>6.3f} s {theirs - ours:>6.3f} s "
            f"{1e3 * per_meter:>10.1f} ms/m"
            for leg, (ours, theirs, per_meter) in enumerate(rows, 1)
        ]
    return "\n".join([*lines, *(f"note: {note}" for note in notes_on(problem, best))])
