"""Best known laps and lower bounds of several tracks and drones: one JSON file for each pair."""

import dataclasses
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.provenance import provenance
from quadjax.core.resources import PRETRAINED
from quadjax.limits import run
from quadjax.limits.bound import LowerBound
from quadjax.limits.problem import Problem
from quadjax.limits.report import read_guess, write_flight, write_unverified
from quadjax.limits.trajectory import Trajectory
from quadjax.policy.file import Policy

if TYPE_CHECKING:
    from quadjax.limits.best_known import BestKnown
    from quadjax.limits.solve import Search

TRACKS = ("square4", "figure8", "figure8_tudelft", "split_s", "grand_challenge")
DRONES = {  # by name: a preset and overrides
    "Bebop E2E": ("e2e_race",),
    "Bebop INDI": ("indi_fastest",),
    "5-inch": ("e2e_fastest", "vehicle=5inch"),
    "3-inch": ("e2e_fastest", "vehicle=3inch"),
    "A2RL": ("e2e_fastest", "vehicle=a2rl"),
}
POLICIES = {("square4", "Bebop E2E"): "e2e_fastest", ("square4", "Bebop INDI"): "indi"}
SHARES = 0.6, 0.2  # of a cell's time: the best known lap, and that through the centers


def file_of(folder: Path, track: str, drone: str) -> Path:
    """The result of one cell."""
    return folder / f"{track}_{drone.lower().replace(' ', '_')}.json"


def make(
    folder: Path,
    tracks: list[str],
    drones: list[str],
    seconds: float,
    policies: Path | None,
    stop: threading.Event,
    report: Callable[[str], object],
    starts: int = 2,
    centers: bool = True,
) -> None:
    """Compute the cells that the folder lacks.

    Args:
        folder: where each cell has its ``.json`` and its best known lap as ``.npz``.
        tracks: names of tracks.
        drones: of ``DRONES``.
        seconds: processor time of a cell's searches at most.
        policies: folder of policies to compare with, named as the results; None: the shipped ones.
        stop: if set, the current cell ends with the best so far, and no other begins.
        report: called with one line on the progress.
        starts: number of initial guesses, in addition to a policy's lap.
        centers: whether to search the lap through the centers, too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for track in tracks:
        for drone in drones:
            path = file_of(folder, track, drone)
            if path.exists() or stop.is_set():
                continue
            table = path.with_suffix(".npz")
            result = cell(track, drone, seconds, policies, table, stop, report, starts, centers)
            if not stop.is_set():
                write_json(path, result)


def cell(
    track: str,
    drone: str,
    seconds: float,
    policies: Path | None,
    table: Path,
    stop: threading.Event,
    report: Callable[[str], object],
    starts: int,
    centers: bool,
) -> dict[str, Any]:
    """One track and drone: best known lap, lower bound, lap through the centers, policy."""
    from quadjax.limits.best_known import NotFoundError
    from quadjax.limits.solve import Search

    began = time.process_time()
    preset, *overrides = DRONES[drone]
    config = load_config(preset, [f"track={track}", *overrides])
    choices, params = race_of(config)
    result: dict[str, Any] = {"track": track, "drone": drone}
    result["provenance"] = provenance(config)
    race = run.Race(fitted_speed=config.vehicle.fitted_speed)
    problem = run.problem_of(choices, params, race)
    laps = _laps(config, problem, _policy(policies, track, drone))
    given = {"policy's lap": laps[0]} if laps else {}
    if table.exists():  # of a computation that was interrupted
        given["earlier flight"] = read_guess(problem, str(table))
    show = lambda text: report(f"{track}, {drone}: {text}")  # noqa: E731
    try:
        best = run.search(
            problem, given, starts=starts, seconds=SHARES[0] * seconds, stop=stop, report=show
        )
    except NotFoundError as error:
        if error.unverified is not None and not table.exists():
            write_unverified(table, error.unverified)
        return result | {"error": str(error), "seconds": time.process_time() - began}
    write_flight(table, config.vehicle.model, config.track.gates, problem, best, result)
    bound = run.bound_of(problem, best, None)
    result |= {
        "best_known": best.total,
        "lower_bound": bound.time if isinstance(bound, LowerBound) else None,
        "lower_bound_below_speed": bound.mass.speed if isinstance(bound, LowerBound) else None,
        "lower_bound_error": None if isinstance(bound, LowerBound) else bound,
        "top_speed": best.check.top_speed,
        "mesh_change": best.mesh_change if np.isfinite(best.mesh_change) else None,
        "guess": best.guess,
        "notes": list(best.notes),
        "policy": laps[0].total if laps else None,
        "gap": laps[0].total / best.total - 1.0 if laps else None,
    }
    if centers:
        exact = run.problem_of(choices, params, dataclasses.replace(race, clearance=None))
        result |= _through_centers(Search(exact, SHARES[1] * seconds, stop, show), best)
    return result | {"seconds": time.process_time() - began}


def _through_centers(search: "Search", best: "BestKnown") -> dict[str, Any]:
    """The lap through the centers, from the best known lap, as part of a cell's result."""
    from quadjax.limits.best_known import NotFoundError

    try:
        found = search.run([("best known lap", best.trajectory.resample(run.INTERVALS))])
    except NotFoundError as error:
        return {"centers": None, "centers_error": str(error)}
    if not np.isfinite(found.mesh_change):  # the search ended before it converged
        return {"centers": None, "centers_error": "the mesh was not refined"}
    return {"centers": found.total}


def _policy(folder: Path | None, track: str, drone: str) -> Path | None:
    """A pair's policy: that of a folder, or the shipped one, if there is one."""
    own = None if folder is None else file_of(folder, track, drone).with_suffix(".npz")
    if own is not None and own.exists():
        return own
    shipped = POLICIES.get((track, drone))
    return None if shipped is None else PRETRAINED / f"{shipped}.npz"


def _laps(config: Config, problem: Problem, path: Path | None) -> list[Trajectory]:
    """The laps of a policy, if there is one."""
    if path is None:
        return []
    return run.policy_laps(*race_of(config), problem, Policy.load(path), str(path))


def markdown(folder: Path, tracks: list[str]) -> str:
    """The table of the cells in a folder."""
    lines = [
        "| track, drone | lower bound | best known | centers | policy | gap | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for track in tracks:
        for drone in DRONES:
            path = file_of(folder, track, drone)
            if path.exists():
                lines.append(_row(f"{track}, {drone}", _read(path)))
    return "\n".join(lines)


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not a result of this command ({error})") from None


def _row(name: str, result: dict[str, Any]) -> str:
    def seconds(key: str) -> str:
        value = result.get(key)
        return "" if value is None else f"{value:.3f} s"

    gap = result.get("gap")
    cells = [
        name,
        *(seconds(key) for key in ("lower_bound", "best_known", "centers", "policy")),
        "" if gap is None else f"{100.0 * gap:.1f}%",
        f"{result['seconds']:.0f}",
    ]
    return f"| {' | '.join(cells)} |"
