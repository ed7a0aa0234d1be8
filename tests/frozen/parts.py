"""What is frozen, one function a part: public functions, commands and files only.

A part maps a name to a ``Record``: a digest of every bit, and a few values that show how large a
difference is. Files and folders of a part are in the current folder, which is empty at first.
"""

import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import quadjax
from tests.commands import run
from tests.frozen import c_code

ROOT = Path(__file__).resolve().parents[2]
FLIGHT_DATA = ROOT.parent / "shared/flight_data"
ONE = "run.devices=1"
TIMES = re.compile(r"second|memory|time$|steps_per|finished")  # not frozen: clocks, a new column
TRAININGS = {
    "PPO, motor": ("e2e_ppo", ()),
    "PPO, rate": ("indi_ppo", ()),
    "PPO, racing": ("e2e_ppo", ("vehicle=5inch", "track=figure8_tudelft")),
    "SHAC, motor": ("e2e", ()),
    "SHAC, rate": ("indi", ()),
    "SHAC, racing": ("e2e_race", ("vehicle=5inch", "track=figure8_tudelft")),
}
RACES = {  # shipped policy: the race it was trained in
    "e2e_residual": "e2e +residual",
    "e2e_residual_disturbance": "e2e +residual +disturbance",
    "e2e_fastest": "e2e +fastest",
    "e2e": "e2e",
    "indi_fastest": "indi +fastest",
    "indi": "indi",
}
LIMITS = {
    "square4, Bebop E2E": ("e2e +fastest",),
    "square4, Bebop INDI": ("indi +fastest",),
    "square4, 5-inch": ("e2e_race", "vehicle=5inch"),
    "figure8_tudelft, 3-inch": ("e2e_race", "vehicle=3inch", "track=figure8_tudelft"),
    "figure8, A2RL": ("e2e_race", "vehicle=a2rl", "track=figure8"),
}


@dataclasses.dataclass(frozen=True)
class Record:
    """One frozen result."""

    sha256: str  # of all its numbers
    values: tuple[float, ...]  # some of them


def record(arrays: list[np.ndarray], values: list[float]) -> Record:
    """The record of arrays, bit for bit."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return Record(digest.hexdigest(), tuple(float(f"{value:.7g}") for value in values))


def command(*arguments: object) -> str:
    """What a command prints; it has to succeed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        status = run(*arguments)
    if status != 0:
        raise RuntimeError(f"quadjax {' '.join(map(str, arguments))}: status {status}")
    return printed.getvalue()


def numbers_of(text: str) -> np.ndarray:
    """Every number of a text, in its order."""
    return np.array([float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)])


def columns_of(path: Path, leave_out: re.Pattern[str]) -> dict[str, np.ndarray]:
    """The columns of a CSV file; empty cells are NaN."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        name: np.array([float(row[name]) if row[name] else np.nan for row in rows])
        for name in rows[0]
        if not leave_out.search(name)
    }


def training() -> Iterator[tuple[str, Record]]:
    """Metrics and last policy of 300,000 steps of six trainings."""
    for name, (preset, overrides) in TRAININGS.items():
        config = quadjax.load(preset, [*overrides, ONE, "run.steps=300000", "seed=0"])
        folder = Path(re.sub(r"\W+", "_", name))
        quadjax.train(config, folder, progress=False)
        metrics = columns_of(folder / "metrics.csv", TIMES)
        with np.load(folder / "policy_last.npz") as file:
            policy = [file[key] for key in sorted(file) if key != "meta"]
        last = [column[np.isfinite(column)] for column in metrics.values()]
        values = [column[-1] for column in last if len(column)]
        yield name, record([*metrics.values(), *policy], values[:6])


def exports() -> Iterator[tuple[str, Record]]:
    """Commands of the exported C in 5,000 random states, shipped policies and layouts."""
    for name, policy, options in c_code.cases(RACES):
        commands = c_code.commands(policy, Path(name.replace(" ", "_")), options, command)
        yield name, record([commands], list(commands.astype(float).mean(axis=0)))


def flights() -> Iterator[tuple[str, Record]]:
    """100 sampled flights of each shipped policy, from hover and in drawn drones."""
    for policy, preset in RACES.items():
        base = ("evaluate", preset, "--policy", policy)
        for protocol, more in {"sampled": (), "mean": ("--deterministic",)}.items():
            files = ("--json", f"{policy}.json", "--states", f"{policy}.npz")
            command(*base, "--runs", 100, *more, *files)
            laps = json.loads(Path(f"{policy}.json").read_text())
            with np.load(f"{policy}.npz") as states:
                arrays = [states[k] for k in sorted(states) if states[k].dtype.kind == "f"]
            times = [total for total in laps["totals"] if total is not None]
            values = [laps["finished"], np.median(times) if times else np.nan]
            yield f"{policy}, {protocol}", record(arrays, values)
            Path(f"{policy}.json").unlink()
            Path(f"{policy}.npz").unlink()
        table = numbers_of(command(*base, "--conditions", "spread", "--runs", 100, "--seconds", 6))
        yield f"{policy}, robustness", record([table], list(table))
        table = numbers_of(command(*base, "--conditions", "random-tracks", "--runs", 20))
        yield f"{policy}, random tracks", record([table], list(table))


def plant() -> Iterator[tuple[str, Record]]:
    """100 flights of E2E and INDI on the plant."""
    command(
        "compare",
        "standin",
        "--e2e",
        "e2e",
        "--indi",
        "indi",
        "--deterministic",
        "--drones",
        1,
        "--output",
        "runs",
    )
    worlds = json.loads(Path("runs/compare/compare.json").read_text())["worlds"]
    flights = [world[name] for world in worlds.values() for name in ("E2E", "INDI")]
    table = numbers_of(json.dumps(flights))
    yield "E2E and INDI", record([table], list(table[:12]))


def fit() -> Iterator[tuple[str, Record]]:
    """Constants and errors of the fit to four real flights; nothing without their files."""
    if not FLIGHT_DATA.is_dir():
        return
    config = Path("four.yaml")
    config.write_text((Path(__file__).parent / "four_flights.yaml").read_text())
    command("fit", config, f"logs.files=[{FLIGHT_DATA}/*.csv]", "--output", "runs")
    vehicle = Path("runs/four/vehicle.yaml").read_text().splitlines()
    constants = numbers_of("\n".join(line.partition("#")[0] for line in vehicle))
    errors = numbers_of(Path("runs/four/report.txt").read_text())
    yield "constants", record([constants], list(constants[:16]))
    yield "errors", record([errors], list(errors[:16]))


LIMIT_ONLY = ("flown_command", "flown_position", "leg_times")  # arrays of no flight
LIMIT_ARRAYS = (
    *("actuators", "command", "attitude", *LIMIT_ONLY, "position", "rates", "time", "velocity"),
)


def limits() -> Iterator[tuple[str, Record]]:
    """Best known laps of five pairs of track and drone."""
    for name, (preset, *overrides) in LIMITS.items():
        files = ("--json", "limit.json", "--npz", "limit.npz")
        command("limit", preset, *overrides, *files)
        result = json.loads(Path("limit.json").read_text())
        with np.load("limit.npz") as file:
            arrays = [file[key] if key in LIMIT_ONLY else file[key][0] for key in LIMIT_ARRAYS]
        yield name, record(arrays, [result["best_known"]])


def estimates() -> Iterator[tuple[str, Record]]:
    """States of the navigation filter in one flight on the plant, as its log has them."""
    command("logs", "standin", "--policy", "e2e_residual", "--flights", 1, "--laps", 2,
            "--output", "logs")  # fmt: skip
    columns = columns_of(Path("logs/e2e_residual_0.csv"), re.compile("mode"))
    yield "EKF", record(list(columns.values()), [column.mean() for column in columns.values()])


PARTS: dict[str, Callable[[], Iterator[tuple[str, Record]]]] = {
    part.__name__: part for part in (training, exports, flights, plant, fit, limits, estimates)
}
TOLERANCES = {  # relative, of the values on another kind of machine; None: too chaotic to compare
    "training": None,
    "exports": 1e-4,  # functions of the C library
    "flights": 0.02,
    "plant": 0.05,
    "fit": 1e-3,
    "limits": 2e-3,
    "estimates": None,
}
