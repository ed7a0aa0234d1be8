"""Rows of tables of other data files: best known laps."""

from benchmarks.settings import Tree
from benchmarks.tracks import read_best

DRONES = {"bebop1": "Bebop 1", "5inch": "5-inch", "3inch": "3-inch", "a2rl": "A2RL"}
INDI = "Bebop 1, INDI"


def best_laps(_: object) -> list[Tree]:
    """The best known laps of each track that is no random one, s."""
    made: dict[str, Tree] = {}
    for file, titles in (("best_known", DRONES), ("best_known_indi", {"bebop1": INDI})):
        for (track, vehicle), lap in read_best(file).items():
            if not track.startswith("random"):
                row = made.setdefault(track, dict.fromkeys([*DRONES.values(), INDI], "-"))
                row |= {"track": f"`{track}`", titles[vehicle]: f"{lap.seconds:g}"}
    return list(made.values())
