"""The best known flight of a race: the search for it, its text, its JSON, and its file."""

import dataclasses
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config, Disturbance, Randomization
from quadjax.core.errors import InputError
from quadjax.core.provenance import provenance
from quadjax.flights import flight as recorded
from quadjax.flights.files import load, save
from quadjax.flights.flight import SIMULATED
from quadjax.limits.guess import policy_lap
from quadjax.limits.problem import TIME_STEP_S, FlightOptions, Problem, make_problem
from quadjax.limits.search import MESH_CHANGE, BestKnown, NotFoundError, Search
from quadjax.limits.trajectory import Trajectory


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """The best known flight of a race."""

    config: Config
    problem: Problem  # what was solved
    best: BestKnown
    policy: str | None = None  # file of the policy whose lap was an initial guess

    def notes(self) -> list[str]:
        """Remarks on the result, one sentence each."""
        check, notes, fitted = self.best.check, [], self.problem.flight.fitted_speed or np.inf
        if check.top_speed > 0.99 * self.problem.speed_limit:
            notes.append(
                f"the flight reaches the speed limit of {self.problem.speed_limit:g} m/s; the "
                "vehicle model may not hold there"
            )
        above = TIME_STEP_S * np.sum(np.linalg.norm(check.velocity, axis=1) > fitted)
        if above > 0.0:
            notes.append(
                f"for {above:.2f} s the flight is faster than {fitted:g} m/s, the highest speed of "
                "the flights that the model is fitted to"
            )
        if self.best.mesh_change > MESH_CHANGE:
            notes.append("the mesh was not refined until the time converged")
        return notes

    def table(self) -> str:
        """The result in a few lines of text."""
        best = self.best
        line = (
            f"best known: {best.total:.4f} s, top speed {best.check.top_speed:.1f} m/s, from the "
            f"{best.guess} ({best.seconds:.0f} s of computing)"
        )
        return "\n".join([line, *(f"note: {note}" for note in self.notes())])

    def to_json(self) -> dict[str, Any]:
        """The result, with the settings that it was computed with."""
        best, check, problem = self.best, self.best.check, self.problem
        return {
            "best_known": best.total,
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
            "notes": self.notes(),
            "start": "periodic" if problem.periodic else "hover",
            "gates": len(problem.order),
            "speed_limit": problem.speed_limit,
            "flight": dataclasses.asdict(problem.flight),
            "provenance": provenance(self.config, self.policy),
        }

    def save(self, path: Path | str) -> None:
        """Write the flight as an ``.npz`` file, with the entries of ``to_json`` in ``meta``.

        Its samples are the nodes of the mesh, as many in each leg of ``leg_times`` (legs,), s.
        ``flown_position`` (m + 1, 3) and ``flown_command`` (m, commands) are of the verification,
        each command held for 1 ms.
        """
        check, more = self.best.check, {"leg_times": self.best.trajectory.leg_times}
        more |= {"flown_position": check.position, "flown_command": check.commands}
        save([self.flight()], path, more, **self.to_json())

    def flight(self) -> recorded.Flight:
        """The best known flight; a periodic one can be repeated."""
        periodic, gates = self.problem.periodic, self.config.track.gates
        note = "best known lap, flying start" if periodic else "best known flight from hover"
        source: dict[str, Any] = {"periodic": periodic, "note": note}
        return self.best.trajectory.flight("best known", self.problem.model, gates, **source)


def best_known(
    config: Config,
    flight: FlightOptions | None = None,
    *,
    policy: Path | str | None = None,
    guesses: Sequence[Path | str] = (),
    starts: int = 2,
    seconds: float = 300.0,
    stop: threading.Event | None = None,
    report: Callable[[str], object] = lambda text: None,
) -> Result:
    """Search for the fastest flight of a race and verify it.

    Args:
        config: of the race; its disturbances, randomization and model mismatch are ignored.
        flight: what is flown; None: a periodic lap.
        policy: a policy's file, whose fastest lap is an initial guess.
        guesses: files of ``Result.save``, which are initial guesses.
        starts: number of other initial guesses.
        seconds: limit of wall-clock time.
        stop: if set, the search ends with the best so far.
        report: called with one line on the progress.

    Raises:
        InputError: a rule that is not supported, or a file that cannot be used.
        NotFoundError: no initial guess led to a verified flight.
    """
    vehicle = config.vehicle.replace(mismatch={})
    steady = {"disturbance": Disturbance(), "randomization": Randomization(), "schedules": {}}
    config = config.replace(vehicle=vehicle, **steady)
    flight = dataclasses.replace(flight or FlightOptions(), fitted_speed=vehicle.fitted_speed)
    problem = make_problem(*make_race(config), flight)
    trajectories = {str(path): read_guess(problem, path) for path in guesses}
    report("compiling")
    if policy is not None:
        trajectories["policy's lap"] = policy_lap(problem, config, policy)
    best = Search(problem, seconds, stop, report).run(trajectories, starts)
    return Result(config, problem, best, None if policy is None else str(policy))


def read_guess(problem: Problem, path: Path | str) -> Trajectory:
    """The flight in a file of ``Result.save``, as an initial guess.

    Raises:
        InputError: the file cannot be read, or its flight is not through these gates.
    """
    flight = load(path)[0]
    leg_times = np.diff(flight.passages[:, 0], prepend=0.0)
    legs, nodes = len(problem.order), len(flight.time)
    sizes = 3, 3, 3, 3, len(problem.start) - 13, len(problem.command_range[0])
    if leg_times.shape != (legs,) or nodes < 2 or (nodes - 1) % legs:
        text = f"a flight of {len(leg_times)} legs and {nodes} nodes"
        raise InputError(f"{path}: {text}, expected {legs} legs with as many intervals each")
    if leg_times.min() <= 0.0:
        leg = int(leg_times.argmin())
        raise InputError(f"{path}: leg {leg + 1} takes {leg_times[leg]:g} s, allowed: above 0")
    for name, size in zip(SIMULATED, sizes, strict=True):
        values = flight[name] if name in flight.signals else np.zeros(0)
        if values.shape != (nodes, size) or not np.isfinite(values).all():
            text = f"{name} has the shape {values.shape}"
            raise InputError(f"{path}: {text}, expected finite numbers, {(nodes, size)}")
    *motion, actuators, commands = (flight[name] for name in SIMULATED)
    return Trajectory(leg_times, problem.vectors(motion, actuators), commands)


def save_unverified(path: Path | str, error: NotFoundError, config: Config) -> bool:
    """Write the last solution of a search that failed, for ``read_guess``, if there is one."""
    if error.flight is not None:
        model = make_race(config)[0].model
        flight = error.flight.flight("not verified", model, config.track.gates)
        save([flight], path, not_verified=error.error)
    return error.flight is not None
