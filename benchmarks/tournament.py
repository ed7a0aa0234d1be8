"""E2E against INDI on the drones of ``cyberzoo``, as docs/design/protocol.md says.

A row of ``benchmarks/results/tournament.json`` has the flights of one training. A row that is there
is not measured again, so the same command resumes. Seeds come first.

    python -m benchmarks.tournament --seeds 0 1 2 3 4
"""

import itertools
import shlex
from pathlib import Path
from typing import Annotated, Any

from benchmarks import rows
from benchmarks.flown import flown, identified, numbers, trained
from benchmarks.steps import PRESETS
from quadjax.cli import script
from quadjax.cli.options import LIST, Folder, Seeds
from quadjax.core.errors import InputError

FILE, PLANT, DRONES = "tournament", "cyberzoo", 20
SCOPES = ("all", "each")
LIMITS = {  # those of the presets, as a fitted vehicle file has others
    "E2E": ["vehicle.constants.rpm_max=12000"],
    "INDI": ["vehicle.constants.thrust_max=17", "vehicle.constants.r_max=2"],
}
FLIGHTS = 20  # on a drone, of each policy
Names = Annotated[tuple[str, ...], LIST]


def tournament(
    *,
    scopes: Names = SCOPES,
    contenders: Names = ("E2E", "INDI"),
    drones: Seeds = tuple(range(DRONES)),
    seeds: Seeds = (0,),
    output: Folder = Path("runs/tournament"),
) -> None:
    """Train the contenders, fly them, and write the rows.

    Args:
        scopes: all: one policy for all drones; each: one for each drone, on the fit to its logs.
        contenders: E2E, INDI; for one policy for all also "E2E by PPO" and "INDI by PPO".
        drones: with a policy of their own.
        seeds: of the trainings.
        output: folder of logs, fits and runs.
    """
    for given, allowed in ((scopes, SCOPES), (contenders, tuple(PRESETS))):
        if unknown := set(given) - set(allowed):
            raise InputError(f"unknown {sorted(unknown)}, allowed: {', '.join(allowed)}")
    if "each" in scopes and (others := set(contenders) - set(LIMITS)):
        raise InputError(f"scopes: each has no {sorted(others)}, allowed: all")
    if max(drones) >= DRONES:
        raise InputError(f"drones: {max(drones)}, allowed: 0 to {DRONES - 1}")
    done = {row["name"] for row in rows.read(FILE)}
    for seed, scope in itertools.product(seeds, scopes):
        for drone in drones if scope == "each" else (None,):
            for contender in contenders:
                row = row_of(contender, drone, seed)
                if row["name"] not in done:
                    rows.write(FILE, [row | measure(contender, drone, seed, output)])
                    print(row["name"], flush=True)


def row_of(contender: str, drone: int | None, seed: int) -> dict[str, Any]:
    """Name, command and settings of a training; ``drone`` is None for one policy for all."""
    scope = "all" if drone is None else "each"
    words = f"--scopes {scope} --contenders {shlex.quote(contender)} --seeds {seed}"
    words += "" if drone is None else f" --drones {drone}"
    return {
        "name": f"{contender}, {'all' if drone is None else f'drone {drone}'}, seed {seed}",
        "command": f"python -m benchmarks.tournament {words}",
        "config": [PRESETS[contender]],
        "plant": [PLANT] if drone is None else [PLANT, f"drone={drone}"],
        "seeds": [seed],
        "contender": contender,
        "scope": scope,
        "drone": drone,
    }


def measure(contender: str, drone: int | None, seed: int, output: Path) -> dict[str, Any]:
    """Train and fly."""
    folder = output / ("all" if drone is None else f"drone_{drone}")
    words, plant, count = [], [PLANT], DRONES
    if drone is not None:
        plant, count = [PLANT, f"drone={drone}"], 1
        found = identified(folder, plant, [PRESETS[name] for name in LIMITS])
        words += [f"vehicle.file={found / 'vehicle.yaml'}", *LIMITS[contender]]
        if contender == "E2E":
            words.append(f"vehicle.residual={found / 'residual.npz'}")
    policy = trained(PRESETS[contender], words, seed, folder / f"{contender.lower()}_{seed}")
    return numbers(*flown(policy, plant, FLIGHTS, count))


if __name__ == "__main__":
    script(tournament)
