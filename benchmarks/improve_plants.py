"""What ``quadjax improve`` changes on several drawn plants, as a table.

    for seed in 0 1 2 3 4 5 6 7 8 9; do
        quadjax improve e2e --policy FILE --plant-seed $seed --output runs/ten/$seed
    done
    python -m benchmarks.improve_plants runs/ten/* --json ten.json

The means in docs/design/adaptation.md are made so. A plant whose check flights have
no finisher before or after does not count in the means, which say how many plants they are of.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.core.folders import kind_of
from quadjax.core.markdown import table
from quadjax.improve import KIND

Plant = Mapping[str, Any]


def read(folder: Path) -> Plant:
    """The flights of a folder of ``quadjax improve``: of each round, and before and after."""
    rounds = []
    for place in sorted(folder.glob("round_*"), key=lambda path: int(path.name[6:])):
        refitted, state = read_json(place / "model.json"), "none"
        if refitted["before"]:
            state = "rejected" if refitted.get("rejection", refitted.get("refused")) else "accepted"
        flown = read_json(place / "flights.json")
        rounds.append({"flown": flown, "model": state})
    names = {"before": "check_*_before.json", "after": f"check_*_after_{len(rounds)}.json"}
    names["reference"] = "check_*_reference.json"
    files = {name: list(folder.glob(pattern)) for name, pattern in names.items()}
    check = {name: read_json(paths[0]) for name, paths in files.items() if paths}
    return {"plant": folder.name, "rounds": rounds, "check": check}


def mean(flown: Plant) -> float:
    """Mean time of all laps of the flights that finished, s."""
    done = [total for total in flown["totals"] if total is not None]
    return float(np.mean(done)) if done else float("nan")


def plants_table(plants: Sequence[Plant]) -> str:
    """A row for each plant, and the means over the plants on which every policy finishes."""
    names = ("before", "after", "reference")
    rows = [("plant", *(f"{name}, s" for name in names), "models")]
    whole = [p for p in plants if all(np.isfinite(mean(flown)) for flown in p["check"].values())]
    for plant in plants:
        flown = [plant["check"].get(name) for name in names]
        cells = ["-" if f is None else _cell(f) for f in flown]
        rows.append((plant["plant"], *cells, ", ".join(r["model"] for r in plant["rounds"])))
    known = [name for name in names if all(name in plant["check"] for plant in whole)]
    means = {name: np.mean([mean(plant["check"][name]) for plant in whole]) for name in known}
    cells = [f"{means[name]:.2f}" if name in means and whole else "-" for name in names]
    rows.append((f"mean of {len(whole)} of {len(plants)}", *cells, ""))
    return table(rows)


def _cell(flown: Plant) -> str:
    done = sum(total is not None for total in flown["totals"])
    time = f"{mean(flown):.2f}" if done else "-"
    return f"{time} ({done} of {len(flown['totals'])})"


def improve_plants(
    *folders: Annotated[Path, Parameter(required=True)], json: options.JsonFile = None
) -> None:
    """Print the table of folders of quadjax improve."""
    for folder in folders:
        if not (folder / "table.txt").is_file() or kind_of(folder) != KIND:
            raise InputError(f"{folder}: allowed: the folder of a finished quadjax improve")
    plants = [read(folder) for folder in folders]
    print(plants_table(plants))
    if json:
        write_json(json, plants)


if __name__ == "__main__":
    script(improve_plants)
