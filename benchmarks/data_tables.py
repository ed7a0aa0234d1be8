"""Rows of tables of other data files: best known laps, and ``cyberzoo`` without an effect."""

import re
from pathlib import Path

from benchmarks.settings import Tree
from benchmarks.tracks import read_best
from quadjax.core.files import read_json

DRONES = {"bebop1": "Bebop 1", "5inch": "5-inch", "3inch": "3-inch", "a2rl": "A2RL"}
INDI = "Bebop 1, INDI"
EFFECTS = Path(__file__).parent / "cyberzoo_effects.json"
ONE = re.compile(r"(\w+) (\S+) s, lap 1 \S+, (\d+%)")  # policy of the text of an effect
AGAIN = "again, "  # with all other numbers drawn anew


def best_laps(_: object) -> list[Tree]:
    """The best known laps of each track that is no random one, s."""
    made: dict[str, Tree] = {}
    for file, titles in (("best_known", DRONES), ("best_known_indi", {"bebop1": INDI})):
        for (track, vehicle), lap in read_best(file).items():
            if not track.startswith("random"):
                row = made.setdefault(track, dict.fromkeys([*DRONES.values(), INDI], "-"))
                row |= {"track": f"`{track}`", titles[vehicle]: f"{lap.seconds:g}"}
    return list(made.values())


def ablations(_: object) -> list[Tree]:
    """The flights without each effect, alone and with all other numbers drawn anew."""

    def told(entry: Tree, prefix: str) -> Tree:
        log = entry["log_likelihood"]
        known = {f"{prefix}log-likelihood": "-" if log is None else f"{log:.0f}"}
        flown = ONE.findall(entry["text"])
        return known | {f"{prefix}{a}": f"{b.replace('nan', '-')} ({c})" for a, b, c in flown}

    found, made = read_json(EFFECTS), []
    for key, entry in found.items():
        if key.endswith(", again"):
            made[-1] |= told(entry, AGAIN)
        else:
            empty = dict.fromkeys((f"{AGAIN}{x}" for x in ("log-likelihood", "E2E", "INDI")), "")
            name = key.removeprefix("without ")
            made.append({"without": "nothing" if name == "all" else f"`{name}`"})
            made[-1] |= empty | told(entry, "")
    return made
