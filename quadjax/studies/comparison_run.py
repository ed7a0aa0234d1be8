"""The whole comparison: flights, tables, figures and files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.race import race_of
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import file_record, provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.evaluation.tables import Row, format_table, lap_row
from quadjax.flights.flight import Flight, recorded_flights
from quadjax.plant import flights as plant_flights
from quadjax.plant.config import PlantConfig
from quadjax.plant.races import race_config
from quadjax.race.laps import Laps
from quadjax.studies.ablation import present
from quadjax.studies.comparison import (
    FLIGHTS,
    Compared,
    Contender,
    Report,
    Setting,
    compare_one,
    fly_conditions,
    fly_variant,
    lead,
    limit_fractions,
    rows,
)
from quadjax.studies.drawn_plants import (
    OnPlants,
    common_flights,
    conditions,
    interval,
    plants_table,
)
from quadjax.studies.report.run import fastest_signals, write_report

PARTS = ("table", "plants", "ablation")
FILES = ("table.txt", "compare.json", "config.yaml", "report/*")


@dataclasses.dataclass(frozen=True)
class Wanted:
    """Parts of a comparison, folder of the ablation's policies, and folder to write to."""

    parts: tuple[str, ...]
    ablation: Path
    folder: Path
    conditions: tuple[str, ...] = tuple(conditions(PlantConfig()))  # of the part plants

    def __post_init__(self) -> None:
        """Refuse unknown conditions, and an ablation folder that cannot be read."""
        if "ablation" in self.parts:
            present(self.ablation)
        for name in self.conditions:
            if name not in Wanted.conditions:
                allowed = ", ".join(Wanted.conditions)
                raise InputError(f"--conditions: {name!r}, allowed: {allowed}")


def run_comparison(
    setting: Setting, contenders: tuple[Contender, Contender], wanted: Wanted, report: Report
) -> str:
    """Run the selected parts, write the results, and return the tables as text.

    Args:
        setting: race and plant.
        contenders: E2E and INDI.
        wanted: parts and folders.
        report: called with the progress.

    Raises:
        InputError: policies that do not fit, or files that cannot be read.
    """
    enable_compilation_cache()
    texts: list[str] = []
    result: dict[str, object] = {
        "runs": setting.runs,
        "laps": setting.laps,
        "deterministic": setting.deterministic,
        "provenance": provenance(setting.plant, seed=setting.seed)
        | {"race": provenance(setting.race)["config"]},
    }
    if "table" in wanted.parts:
        e2e, indi = (compare_one(setting, own, report) for own in contenders)
        report("drawing")
        texts.append(table_text(setting, e2e, indi))
        result |= {own.contender.name: _numbers(setting, own) for own in (e2e, indi)}
        _draw(setting, e2e, indi, wanted.folder, result)
    if "plants" in wanted.parts:
        texts.append(_plants(setting, contenders, wanted.conditions, result, report))
    if "ablation" in wanted.parts:
        texts.append(_ablation(setting, wanted.ablation, result, report))
    text = "\n\n".join(texts)
    write_text(wanted.folder / "table.txt", text + "\n")
    write_json(wanted.folder / "compare.json", result)
    write_text(wanted.folder / "config.yaml", to_yaml(setting.plant.model_dump()))
    return text


def table_text(setting: Setting, e2e: Compared, indi: Compared) -> str:
    """The lap table of both contenders, E2E's lead, and the reasons for early ends.

    The published flights are not in it: they are of another drone, residual and noise.
    """
    table = format_table([*rows(e2e), *rows(indi)])
    on_plant, held = limit_fractions(setting, e2e)
    count = min(FLIGHTS, setting.runs)
    notes = [
        f"mean and best of {count} flights on the stand-in plant; finished: of all runs",
        lead(e2e, indi),
        f"E2E's rpm commands at a limit: {100.0 * held:.0f}% simulated, "
        f"{100.0 * on_plant:.0f}% on the stand-in plant",
    ]
    for own in (e2e, indi):
        crashes = [crash for crash in own.on_plant.laps.crashes if crash]
        if crashes:
            kinds = {kind: crashes.count(kind) for kind in dict.fromkeys(crashes)}
            counts = ", ".join(f"{kind} {number}" for kind, number in kinds.items())
            notes.append(f"{own.contender.name} on the stand-in plant, early ends: {counts}")
    return table + "\n" + "\n".join(notes)


def _numbers(setting: Setting, own: Compared) -> dict[str, object]:
    """Numbers of the table for one contender."""
    on_plant, simulated = limit_fractions(setting, own)
    return {
        "policy": file_record(own.contender.file),
        "simulated": own.simulated.to_json(),
        "stand-in plant": own.on_plant.laps.to_json(),
        "commands at a limit": on_plant,
        "commands at a limit, simulated": simulated,
    }


def flights_of(setting: Setting, *compared: Compared) -> dict[str, list[Flight]]:
    """The recorded flights of each contender, in the simulator and on the plant, for a report."""
    gates, dt = setting.race.track.gates, setting.race.rules.time_step
    groups: dict[str, list[Flight]] = {}
    for own in compared:
        name = own.contender.name
        model = race_of(race_config(setting.race, own.contender.policy))[0].model
        simulated = recorded_flights(own.trace, own.simulated, dt, gates, model)[:FLIGHTS]
        groups[f"{name} simulated"] = [
            flight.replace(name=f"{run}") for run, flight in enumerate(simulated, start=1)
        ]
        on_plant = plant_flights.recorded_flights(own.on_plant, gates, model)
        groups[f"{name} stand-in plant"] = on_plant
    return groups


def _draw(setting: Setting, e2e: Compared, indi: Compared, folder: Path, result: dict) -> None:
    """Write the report of the recorded flights, and the errors of the fastest one of each group."""
    groups = flights_of(setting, e2e, indi)
    write_report(groups, setting.race, folder / "report")
    result["rms error to the first-order response"] = {
        label: [round(float(x), 4) for x in np.sqrt((signals.error**2).mean(axis=0))]
        for label, (_, signals) in fastest_signals(groups, setting.race).items()
    }


def _plants(
    setting: Setting,
    contenders: tuple[Contender, Contender],
    only: Sequence[str],
    result: dict,
    report: Report,
) -> str:
    e2e, indi = (fly_conditions(setting, own, report, only) for own in contenders)
    pairs = {label: common_flights(own, indi[label]) for label, own in e2e.items()}
    result["plants"] = {
        own.name: {label: _of_plants(found[label], pairs[label][place]) for label in pairs}
        for place, (own, found) in enumerate(zip(contenders, (e2e, indi), strict=True))
    }
    return plants_table(e2e, indi, setting.plants)


def _of_plants(flown: OnPlants, both: OnPlants) -> dict[str, object]:
    """Total times of the flights that both contenders finish, and the numbers of all flights."""
    mean, width = interval(both.totals)
    return {
        "mean": mean if np.isfinite(mean) else None,
        "interval": width if np.isfinite(width) else None,
        "each plant": [x if np.isfinite(x) else None for x in both.totals.tolist()],
        "both finish": both.finished,
        "finished": flown.finished,
        "runs": flown.runs,
        "crashes": flown.crashes,
    }


def _ablation(setting: Setting, folder: Path, result: dict, report: Report) -> str:
    have, missing = present(folder)
    lines: list[Row] = []
    result["ablation"] = {}
    for variant in have:
        laps = fly_variant(setting, variant, folder, report)
        label = f"{variant.group}: {variant.label}"
        result["ablation"][label] = _summary(laps)
        lines.append(lap_row(label, laps))
    texts = ["ablation: E2E on the stand-in plant, all runs"]
    if lines:
        texts.append(format_table(lines))
    for command in dict.fromkeys(variant.command() for variant in missing):
        texts.append(f"skipped, no policy in {folder.name}/: {command}")
    return "\n".join(texts)


def _summary(laps: Laps) -> dict[str, float | int | None]:
    """Mean and best of the runs that finished, and their number."""
    done = laps.totals[np.isfinite(laps.totals)]
    return {
        "mean": round(float(done.mean()), 3) if done.size else None,
        "best": round(float(done.min()), 3) if done.size else None,
        "finished": laps.finished,
        "runs": len(laps.crashes),
    }
