"""E2E against INDI: flights by one protocol in the simulator and on the stand-in plant."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import file_record, provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.evaluation.conditions import Conditions
from quadjax.evaluation.evaluate import Evaluation, evaluate
from quadjax.evaluation.plants import MOTOR_COMMAND, RECORDED
from quadjax.evaluation.report import fastest_responses, write_report
from quadjax.evaluation.rows import Row, common, interval
from quadjax.evaluation.table import Table, interval_text, lap_table
from quadjax.flights.flight import Flight
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import race_config
from quadjax.policy.file import Policy

PARTS = ("table", "plants")
FILES = ("table.txt", "compare.json", "config.yaml", "report/*")
KINDS = {"E2E": "motor", "INDI": "rate"}  # vehicle model of each contender's policy
WORLDS = {"simulated": "simulated", "on_plant": "stand-in plant"}
Report = Callable[[str], object]


@dataclasses.dataclass(frozen=True)
class Setting:
    """What both contenders fly.

    Attributes:
        race: its vehicle is the model on board.
        plant: the stand-in plant.
        conditions: of the part "plants".
        laps: of a flight.
        runs: number of flights.
        seed: of batteries, gusts, sensors and noise.
        plants: drawn plants of the part "plants", which share the runs.
        deterministic: mean actions rather than samples.
    """

    race: Config
    plant: PlantConfig
    conditions: Conditions
    laps: int = 6
    runs: int = 100
    seed: int = 0
    plants: int = 10
    deterministic: bool = True

    @property
    def protocol(self) -> dict[str, Any]:
        """Arguments of ``evaluate``."""
        keys = ("laps", "runs", "seed", "deterministic")
        return {key: getattr(self, key) for key in keys}


@dataclasses.dataclass(frozen=True)
class Contender:
    """A policy to compare."""

    name: str  # "E2E" or "INDI"
    policy: Policy
    file: str


@dataclasses.dataclass(frozen=True)
class Compared:
    """One contender in the simulator and on the plant."""

    contender: Contender
    simulated: Evaluation
    on_plant: Evaluation

    @property
    def rows(self) -> list[Row]:
        """The rows of both worlds."""
        name = self.contender.name
        worlds = {text: getattr(self, world).row for world, text in WORLDS.items()}
        return [
            dataclasses.replace(row, policy=f"{name} {text}", condition="", published=None)
            for text, row in worlds.items()
        ]

    @property
    def groups(self) -> dict[str, list[Flight]]:
        """The recorded flights of both worlds, for a report."""
        return {
            f"{self.contender.name} {text}": [
                flight.replace(name=str(run))
                for run, flight in enumerate(getattr(self, world).flights[:RECORDED], start=1)
            ]
            for world, text in WORLDS.items()
        }


def read_contenders(e2e: Path, indi: Path) -> tuple[Contender, Contender]:
    """The policy files of E2E and INDI.

    Raises:
        InputError: a file that cannot be read, or a policy for another vehicle.
    """
    files = {"E2E": e2e, "INDI": indi}
    for name, file in files.items():
        vehicle = Policy.load(file).vehicle
        if vehicle != KINDS[name]:
            raise InputError(
                f"{file}: a policy for the {vehicle} vehicle, expected {KINDS[name]} for "
                f"--{name.lower()}"
            )
    first, second = (Contender(name, Policy.load(file), str(file)) for name, file in files.items())
    return first, second


def compare_one(setting: Setting, contender: Contender, report: Report) -> Compared:
    """Evaluate one contender in the simulator and on the plant."""
    name, policy = contender.name, contender.policy
    report(f"{name}: simulator")
    options = setting.protocol | {"name": contender.file}
    simulated = evaluate(policy, race_config(setting.race, policy), **options)
    report(f"{name}: stand-in plant")
    on_plant = evaluate(policy, setting.race, plant=setting.plant, **options)
    return Compared(contender, simulated, on_plant)


def run_comparison(
    setting: Setting,
    contenders: tuple[Contender, Contender],
    parts: Sequence[str],
    folder: Path,
    report: Report,
) -> str:
    """Fly the parts, write ``FILES`` to a folder, and return the tables as text.

    Args:
        setting: race, plant and conditions.
        contenders: E2E and INDI.
        parts: some of ``PARTS``.
        folder: to write to.
        report: called with the progress.

    Raises:
        InputError: policies that do not fit, or files that cannot be read.
    """
    texts: list[str] = []
    result: dict[str, Any] = {
        "runs": setting.runs,
        "laps": setting.laps,
        "deterministic": setting.deterministic,
        "provenance": provenance(setting.plant, seed=setting.seed)
        | {"race": provenance(setting.race)["config"]},
    }
    if "table" in parts:
        e2e, indi = (compare_one(setting, each, report) for each in contenders)
        report("drawing")
        texts.append(table_text(setting, e2e, indi))
        result |= {each.contender.name: _numbers(setting, each) for each in (e2e, indi)}
        groups = e2e.groups | indi.groups
        write_report(groups, setting.race, folder / "report")
        result["rms error to the first-order response"] = {
            label: [round(float(x), 4) for x in found.rms]
            for label, (_, found) in fastest_responses(groups, setting.race).items()
        }
    if "plants" in parts:
        first, second = (fly_conditions(setting, each, report) for each in contenders)
        texts.append(plants_table(first, second))
        result["plants"] = {
            each.name: plant_numbers(first, second, place) for place, each in enumerate(contenders)
        }
    text = "\n\n".join(texts)
    write_text(folder / "table.txt", text + "\n")
    write_json(folder / "compare.json", result)
    write_text(folder / "config.yaml", to_yaml(setting.plant.model_dump()))
    return text


def _numbers(setting: Setting, compared: Compared) -> dict[str, Any]:
    """Numbers of the table for one contender."""
    on_plant, simulated = limit_fractions(setting, compared)
    return {
        "policy": file_record(compared.contender.file),
        "simulated": compared.simulated.laps.to_json(),
        "stand-in plant": compared.on_plant.laps.to_json(),
        "commands at a limit": on_plant,
        "commands at a limit, simulated": simulated,
    }


def table_text(setting: Setting, e2e: Compared, indi: Compared) -> str:
    """The lap table of both contenders, E2E's lead, and how flights ended early.

    The published flights are not in it: they are of another drone, residual and noise.
    """
    on_plant, simulated = limit_fractions(setting, e2e)
    share = "-" if simulated is None else f"{100.0 * simulated:.0f}%"
    notes = [
        lead(e2e, indi),
        f"E2E's rpm commands at a limit: {share} simulated, "
        f"{100.0 * on_plant:.0f}% on the stand-in plant",
    ]
    return "\n".join([lap_table([*e2e.rows, *indi.rows]).format(), *notes])


def limit_fractions(setting: Setting, compared: Compared) -> tuple[float, float | None]:
    """Fraction of rpm commands at a limit: on the plant, and simulated (None without motors).

    The last sample of a simulated flight is its end, after the last command.
    """
    constants = setting.race.vehicle.with_model("motor").constants

    def fraction(commands: Sequence[np.ndarray]) -> float:
        command = np.concatenate(commands)
        low, high = constants["rpm_min"] + 1.0, constants["rpm_max"] - 1.0
        return float(((command <= low) | (command >= high)).mean())

    on_plant = fraction([flight[MOTOR_COMMAND] for flight in compared.on_plant.flights])
    if compared.contender.policy.vehicle != "motor":
        return on_plant, None
    return on_plant, fraction([flight["command"][:-1] for flight in compared.simulated.flights])


def lead(e2e: Compared, indi: Compared) -> str:
    """E2E's lead over INDI on the flights that both finish as text; positive if E2E is faster."""
    totals, firsts, later = [], [], []
    for world, text in WORLDS.items():
        rows = [getattr(each, world).row for each in (e2e, indi)]
        where = text if world == "simulated" else f"on the {text}"
        for each, row in zip((e2e, indi), rows, strict=True):
            if not row.finished:
                return f"E2E's lead over INDI: {each.contender.name} finished no run {where}"
        first, second = common(*rows)
        if not first.finished:
            return f"E2E's lead over INDI: both finished no run of one seed {where}"
        ahead = np.subtract(second.lap_means, first.lap_means)
        totals.append(f"{ahead.sum():+.2f} s {where}")
        firsts.append(f"{ahead[0]:+.2f}")
        later += [f"{ahead[1:].mean():+.2f}"] if len(ahead) > 1 else []
    text = f"E2E's lead over INDI: {', '.join(totals)}; first lap {' -> '.join(firsts)} s"
    return f"{text}, each later lap {' -> '.join(later)} s" if later else text


def fly_conditions(setting: Setting, contender: Contender, report: Report) -> Evaluation:
    """A contender on the drawn plants under each condition."""
    conditions = setting.conditions.replace(deterministic=setting.deterministic)
    return evaluate(
        contender.policy,
        setting.race,
        conditions=conditions,
        plant=setting.plant,
        plants=setting.plants,
        laps=setting.laps,
        runs=setting.runs,
        seed=setting.seed,
        name=contender.name,
        progress=report,
    )


def plants_table(e2e: Evaluation, indi: Evaluation) -> str:
    """Both contenders under every condition as text, and E2E's lead on the same flights.

    Total times are of the flights that both finish: the same plants, batteries and gusts. Intervals
    of 95% are over the plants.
    """
    lines, notes = [], []
    for own, other in zip(e2e.rows, indi.rows, strict=True):
        pair, label = common(own, other), own.condition
        texts = [interval_text(row.plant_totals) for row in pair]
        counts = [f"{row.finished}/{row.runs}" for row in (own, other)]
        lines.append([label, texts[0], counts[0], texts[1], counts[1]])
        if pair[0].finished < own.runs:
            plants = int(np.isfinite(pair[0].plant_totals).sum())
            notes.append(
                f"{label}: both finish {pair[0].finished} of {own.runs} flights, on {plants} of "
                f"{own.plants} plants"
            )
    for name, flown in (("E2E", e2e), ("INDI", indi)):
        for row in flown.rows:
            counts = [f"{reason} {number}" for reason, number in row.ends.items()]
            notes += [f"{name}, {row.condition}, early ends: {', '.join(counts)}"] * bool(counts)
    first, second = common(e2e.rows[0], indi.rows[0])
    ahead = second.plant_laps - first.plant_laps
    later = ahead[:, 1:].mean(axis=1) if ahead.shape[1] > 1 else ahead[:, 0] * np.nan
    notes += [
        f"E2E's lead, {e2e.rows[0].condition}: {interval_text(ahead.sum(axis=1), True)} s; first "
        f"lap {interval_text(ahead[:, 0], True)} s, each later lap {interval_text(later, True)} s"
    ]
    count = e2e.rows[0].plants
    title = f"{count} drawn plants: total time of the flights that both finish, s, with 95%\n"
    title += "intervals over the plants; finished: of all flights"
    table = Table(["", "E2E", "finished", "INDI", "finished"], lines, notes=notes)
    return f"{title}\n{table.format()}"


def plant_numbers(e2e: Evaluation, indi: Evaluation, place: int) -> dict[str, Any]:
    """Numbers of one contender under every condition, by label; ``place`` 0 is E2E.

    Total times are of the flights that both finish, the other numbers of all.
    """
    numbers = {}
    for pair in zip(e2e.rows, indi.rows, strict=True):
        row, both = pair[place], common(*pair)[place]
        mean, width = interval(both.plant_totals)
        numbers[row.condition] = {
            "mean": mean if np.isfinite(mean) else None,
            "interval": width if np.isfinite(width) else None,
            "each plant": [x if np.isfinite(x) else None for x in both.plant_totals.tolist()],
            "both finish": both.finished,
            "finished": row.finished,
            "runs": row.runs,
            "crashes": row.ends,
        }
    return numbers
