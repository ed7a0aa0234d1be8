"""Rows of the tables of docs/design/comparison.md, from those of tournament and interventions."""

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.settings import Tree
from benchmarks.steps import CHANGES, PRESETS
from quadjax.evaluation.leads import Leads, leads, totals

FAILED_AFTER = 35.0  # s: what a flight that does not finish counts as
SCOPES = {"all": "one for all", "each": "one for each"}


def flights(rows: Iterable[Tree]) -> np.ndarray:
    """Laps (drones, seeds, flights, laps) of rows, s, with NaN in flights that do not finish.

    Of rows with one policy for each drone, a seed is used where all drones have it.
    """
    seeds: dict[int, list[np.ndarray]] = {}
    for row in sorted(rows, key=lambda row: (row["seeds"][0], row.get("drone") or 0)):
        seeds.setdefault(row["seeds"][0], []).append(np.array(row["laps"], float))
    joined = [np.concatenate(parts) for parts in seeds.values()]
    most = max(map(len, joined))
    return np.stack([laps for laps in joined if len(laps) == most], axis=1)


def described(label: str, laps: np.ndarray, rows: Sequence[Tree]) -> Tree:
    """What a table shows of a contender's flights."""
    times = laps.sum(axis=-1)
    done = np.isfinite(times)
    finished = sum(row["mean action, finished"] for row in rows)
    seeds = totals(laps, FAILED_AFTER).mean(axis=(0, 2))
    simulated = [row["simulated"] for row in rows if "simulated" in row]
    return {
        "contender": label.replace("m/s^2", "m/s²"),
        "drones and seeds": f"{laps.shape[0]}, {laps.shape[1]}",
        "score, s": float(seeds.mean()),
        "of each seed, s": ", ".join(f"{score:.2f}" for score in seeds),
        "time, s": f"{times[done].mean():.2f}" if done.any() else "-",
        "finished": f"{100 * done.mean():.1f}%",
        "mean action, finished": f"{finished} of {done.size}",
        "simulated, s": f"{np.mean(simulated):.2f}" if simulated else "-",
    }


def contenders(data: dict[str, list[Tree]]) -> list[Tree]:
    """A line for each contender and scope of the tournament."""
    made = []
    for scope, title in SCOPES.items():
        for name in PRESETS:
            rows = [r for r in data["tournament"] if (r["contender"], r["scope"]) == (name, scope)]
            if rows:
                made.append(described(f"{name}, {title}", flights(rows), rows))
    return made


def of_scope(data: dict[str, list[Tree]], scope: str) -> Leads | None:
    """The lead of E2E over INDI in the tournament; None without rows of both."""
    rows = [
        [r for r in data["tournament"] if (r["contender"], r["scope"]) == (name, scope)]
        for name in ("E2E", "INDI")
    ]
    if not all(rows):
        return None
    e2e, indi = map(flights, rows)
    return leads(e2e, indi, FAILED_AFTER, own=scope == "each")


def lead_rows(data: dict[str, list[Tree]]) -> list[Tree]:
    """The leads of both scopes."""
    made = []
    for scope, title in SCOPES.items():
        if found := of_scope(data, scope):
            made.append(
                {
                    "lead of E2E": title,
                    "score, s": str(found.score),
                    "time, s": str(found.total),
                    "first lap, s": str(found.laps[0]),
                    "each later lap, s": str(found.later),
                    "pairs of flights": f"{found.pairs} of {found.of}",
                }
            )
    return made


def steps(data: dict[str, list[Tree]], of: Iterable[str]) -> list[Tree]:
    """A line for each of some steps of the interventions that has rows."""
    groups = {label: _of_step(data, label) for label in of}
    return [described(label, flights(rows), rows) for label, rows in groups.items() if rows]


def effects(data: dict[str, list[Tree]]) -> list[Tree]:
    """By how much the score falls from one step of the chain to the next."""
    made = []
    for before, after in CHANGES:
        pair = [_of_step(data, label) for label in (before, after)]
        if all(pair):
            earlier, later = map(flights, pair)
            saved = leads(later, earlier, FAILED_AFTER).score
            counts = f"{earlier.shape[1]}, {later.shape[1]}"
            names = [label.replace("m/s^2", "m/s²") for label in (before, after)]
            ends = dict(zip(("from", "to"), names, strict=True))
            made.append(ends | {"trainings": counts, "saved, s": str(saved)})
    return made


def _of_step(data: dict[str, list[Tree]], label: str) -> list[Tree]:
    return [row for row in data["interventions"] if row["step"] == label]
