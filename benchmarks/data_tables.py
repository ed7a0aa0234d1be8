"""Lines of tables of several rows or other data: laps, best known laps, effects of ``cyberzoo``."""

import re
import statistics
from pathlib import Path

from benchmarks.best_laps import DRONES, read_best
from benchmarks.settings import Tree
from quadjax.core.files import read_json

EFFECTS = Path(__file__).parent / "cyberzoo_effects.json"
INDI = "Bebop 1, INDI"
ONE = re.compile(r"(\w+) (\S+) s, lap 1 \S+, (\d+%)")  # one policy, in the text of an effect
AGAIN = "again, "  # with all other numbers drawn anew


def best_laps(_: object) -> list[Tree]:
    """The best known laps, s, of each track that is not random."""
    made: dict[str, Tree] = {}
    for file, titles in (("best_known", DRONES), ("best_known_indi", {"bebop1": INDI})):
        for (track, vehicle), lap in read_best(file).items():
            if not track.startswith("random"):
                row = made.setdefault(track, dict.fromkeys([*DRONES.values(), INDI], "-"))
                row |= {"track": f"`{track}`", titles[vehicle]: f"{lap.seconds:g}"}
    return list(made.values())


def gap(row: Tree) -> list[float | None]:
    """How much longer the laps of a row are than the best known one, %; None without a lap."""
    preset, *words = row["config"]
    track, vehicle = (word.partition("=")[2] for word in words)
    best = read_best("best_known_indi" if preset == "indi_race" else "best_known")
    shortest = best[track, vehicle].seconds
    return [None if lap is None else 100.0 * (lap / shortest - 1.0) for lap in row["lap, s"]]


def laps_of_policies(data: dict[str, list[Tree]]) -> list[Tree]:
    """A line for each track: lap, gap and crashed flights of E2E, medians of the seeds.

    Lap and gap are "-" where a seed has none.
    """

    def middle(values: list[float | None], digits: int) -> str:
        known = [x for x in values if x is not None]
        return f"{statistics.median(known):.{digits}f}" if len(known) == len(values) else "-"

    made: dict[str, Tree] = {}
    for row in data["tracks"]:
        preset, vehicle, track = row["name"].split()
        if preset == "e2e_race":
            line = made.setdefault(track, dict.fromkeys(DRONES.values(), "-"))
            numbers = (row["lap, s"], 3), (gap(row), 1), (row["crashed, %"], 1)
            line["track"] = f"`{track}`"
            line[DRONES[vehicle]] = ", ".join(middle(*each) for each in numbers)
    return list(made.values())


def of_seeds_or_indi(data: dict[str, list[Tree]]) -> list[Tree]:
    """The rows of several seeds and those of INDI, with their gaps."""
    rows = [row | {"gap, %": gap(row)} for row in data["tracks"]]
    return [row for row in rows if len(row["seeds"]) > 1 or row["name"].startswith("indi")]


def ablations(_: object) -> list[Tree]:
    """The flights without each effect, alone and with all other numbers drawn anew."""

    def told(entry: Tree, prefix: str) -> Tree:
        log = entry["log_likelihood"]
        known = {f"{prefix}log-likelihood": "-" if log is None else f"{log:.0f}"}
        flown = ONE.findall(entry["text"])
        return known | {f"{prefix}{a}": f"{b.replace('nan', '-')} ({c})" for a, b, c in flown}

    found, made = read_json(EFFECTS), []
    empty = dict.fromkeys((f"{AGAIN}{x}" for x in ("log-likelihood", "E2E", "INDI")), "")
    for key in (key for key in found if not key.endswith(", again")):
        name, again = key.removeprefix("without "), found.get(f"{key}, again")
        line = {"without": "nothing" if name == "all" else f"`{name}`"} | told(found[key], "")
        made.append(line | (told(again, AGAIN) if again else empty))
    return made
