"""E2E against INDI: flights by one protocol in the simulator and on the stand-in plant."""

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Config, Vehicle
from quadjax.core.errors import InputError, InputWarning
from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import file_record, provenance
from quadjax.core.yaml_files import to_yaml
from quadjax.evaluation.conditions import Conditions
from quadjax.evaluation.evaluate import evaluate
from quadjax.evaluation.plants import MOTOR_COMMAND, RECORDED
from quadjax.evaluation.report import Report
from quadjax.evaluation.result import Evaluation
from quadjax.evaluation.rows import Row, common, interval
from quadjax.evaluation.table import Table, interval_text, lap_table
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import race_config
from quadjax.policy.file import Policy
from quadjax.policy.race import differences, race_of_policy, warn_of_other_race

PARTS = ("table", "plants")
FILES = ("table.txt", "compare.json", "config.yaml", "report/*")
KINDS = {"E2E": "motor", "INDI": "rate"}  # vehicle model of each contender's policy
WORLDS = SIMULATED, ON_PLANT = "simulated", "stand-in plant"
Progress = Callable[[str], object]


@dataclasses.dataclass(frozen=True)
class Contender:
    """A policy, and the race that it flies."""

    file: Path
    policy: Policy
    race: Config  # its vehicle is the model on board

    @property
    def drone(self) -> Vehicle:
        """The vehicle that flies, with the constants of the policy's training."""
        return race_config(self.race, self.policy).vehicle


def contenders(files: Mapping[str, Path], race: Config | None = None) -> dict[str, Contender]:
    """The policies by the names of ``KINDS``, in one race, or each in that of its training.

    Raises:
        InputError: a policy of another vehicle model than ``KINDS`` has for its name, or own races
            with another track or other rules.
    """
    found: dict[str, Contender] = {}
    for name, file in files.items():
        policy = Policy.load(file, race)
        if policy.vehicle != KINDS[name]:
            expected = f"expected {KINDS[name]} for --{name.lower()}"
            raise InputError(f"{file}: a policy for the {policy.vehicle} vehicle, {expected}")
        flown, _ = race_of_policy(policy, file, race)
        found[name] = Contender(file, policy, flown)
        warn_of_other_race(policy, flown, file)
    first, second = found.values()
    for key, there, here in differences(first.race, second.race, ("track", "rules")):
        raise InputError(
            f"{key} is {there} in the race of {first.file}, {here} in that of {second.file}; "
            "allowed: policies of one race, or the race of both (config=CONFIG)"
        )
    return found


def compare(
    entered: Mapping[str, Contender],
    plant: PlantConfig,
    protocol: Mapping[str, Any],
    conditions: Conditions,
    folder: Path,
    report: Progress,
    parts: Sequence[str] = PARTS,
    drones: int = 10,
) -> str:
    """Fly the parts, write ``FILES`` to a folder, and return the tables as text.

    Args:
        entered: the policies, by the names of ``KINDS``.
        plant: the stand-in plant.
        protocol: laps, runs, seed and deterministic, arguments of ``evaluate``.
        conditions: of the part "plants".
        folder: to write to.
        report: called with the progress.
        parts: some of ``PARTS``.
        drones: drawn drones of the part "plants", which share the runs.

    Raises:
        InputError: policies that do not fit, or files that cannot be read.
    """
    texts: list[str] = []
    races = {name: provenance(each.race)["config"] for name, each in entered.items()}
    origin = provenance(plant, seed=protocol["seed"]) | {"races": races}
    keys = ("runs", "laps", "deterministic")
    result: dict[str, Any] = {key: protocol[key] for key in keys} | {"provenance": origin}
    if "table" in parts:
        flown = fly_worlds(entered, plant, protocol, report)
        report("drawing")
        texts.append(table_text({name: each.drone for name, each in entered.items()}, flown))
        for name, each in entered.items():
            simulated, on_plant = (flown[f"{name} {world}"] for world in WORLDS)
            result[name] = {
                "policy": file_record(str(each.file)),
                SIMULATED: simulated.laps.to_json(),
                ON_PLANT: on_plant.laps.to_json(),
                "commands at a limit": limit_fraction(each.drone, on_plant),
                "commands at a limit, simulated": limit_fraction(each.drone, simulated),
            }
        groups = {
            label: [f.replace(name=str(run)) for run, f in enumerate(result.flights[:RECORDED], 1)]
            for label, result in flown.items()
        }
        few = f"the first {RECORDED} of {protocol['runs']} flights of each"
        drawn = Report(groups, entered["E2E"].race, few if protocol["runs"] > RECORDED else "")
        drawn.write(folder / "report")
        result["rms error to the first-order response"] = {
            label: [
                round(float(x), 4)
                for x, unit in zip(signals.rms, signals.units, strict=True)
                if unit == signals.units[0]  # of the rotors, or of the body rates
            ]
            for label, (_, signals) in drawn.responses().items()
        }
    if "plants" in parts:
        options = dict(protocol) | {"plant": plant, "drones": drones, "progress": report}
        options["conditions"] = conditions.replace(deterministic=protocol["deterministic"])
        first, second = (
            _fly(each, each.race, name=name, **options) for name, each in entered.items()
        )
        text, result["plants"] = plants_table(first.rows, second.rows)
        texts.append(text)
    text = "\n\n".join(texts)
    write_text(folder / "table.txt", text + "\n")
    write_json(folder / "compare.json", result)
    write_text(folder / "config.yaml", to_yaml(plant.model_dump()))
    return text


def fly_worlds(
    entered: Mapping[str, Contender],
    plant: PlantConfig,
    protocol: Mapping[str, Any],
    report: Progress,
) -> dict[str, Evaluation]:
    """Flights of the policies in the simulator and on the plant, by "POLICY WORLD"."""
    flown = {}
    for name, each in entered.items():
        for world, config, drone in (
            (SIMULATED, race_config(each.race, each.policy), None),
            (ON_PLANT, each.race, plant),
        ):
            report(f"{name} {world}")
            result = _fly(each, config, name=str(each.file), plant=drone, **protocol)
            flown[f"{name} {world}"] = result
    return flown


def _fly(entered: Contender, config: Config, **options: Any) -> Evaluation:
    """``evaluate`` without its warning of another race, which ``contenders`` gives."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*: trained in another race", InputWarning)
        return evaluate(entered.policy, config, **options)


def table_text(drones: Mapping[str, Vehicle], flown: Mapping[str, Evaluation]) -> str:
    """The lap table of ``fly_worlds``, E2E's lead, commands at a limit, and early ends of flights.

    The published flights are not in it: they are of another drone, residual and noise.
    """
    rows = {
        label: dataclasses.replace(result.row, policy=label, condition="", published=None)
        for label, result in flown.items()
    }
    notes = [lead(world, rows[f"E2E {world}"], rows[f"INDI {world}"]) for world in WORLDS]
    for name, drone in drones.items():
        shares = {world: limit_fraction(drone, flown[f"{name} {world}"]) for world in WORLDS}
        texts = [f"{100.0 * x:.0f}% {world}" for world, x in shares.items() if x is not None]
        notes.append(f"{name}'s rpm commands at a limit: {', '.join(texts) or '-'}")
    return "\n".join([lap_table(list(rows.values())).format(), *notes])


def limit_fraction(vehicle: Vehicle, result: Evaluation) -> float | None:
    """Fraction of rpm commands at a limit; None for a simulation without motors.

    The last sample of a simulated flight is its end, after the last command.
    """
    constants, commands = vehicle.with_model("motor").constants, []
    for flight in result.flights:
        if MOTOR_COMMAND in flight.signals:
            commands.append(flight[MOTOR_COMMAND])
        elif flight.signals["command"].unit == "rpm":
            commands.append(flight["command"][:-1])
    if not commands:
        return None
    command, low, high = np.concatenate(commands), constants["rpm_min"], constants["rpm_max"]
    return float(((command <= low + 1.0) | (command >= high - 1.0)).mean())


def lead(label: str, e2e: Row, indi: Row) -> str:
    """E2E's lead over INDI on the flights that both finish as text; positive if E2E is faster.

    With 95% intervals over drawn drones, if there are several.
    """
    first, second = common(e2e, indi)
    text = f"E2E's lead over INDI, {label}"
    if not first.finished:
        return f"{text}: no flight that both finish"
    text += f", on the {first.finished} of {e2e.runs} flights that both finish"
    ahead = second.drone_laps - first.drone_laps
    text += f": {interval_text(ahead.sum(axis=1), True)} s; first lap "
    text += f"{interval_text(ahead[:, 0], True)} s"
    if ahead.shape[1] > 1:
        text += f", each later lap {interval_text(ahead[:, 1:].mean(axis=1), True)} s"
    return text


def plants_table(e2e: Sequence[Row], indi: Sequence[Row]) -> tuple[str, dict[str, Any]]:
    """Both contenders on drawn drones under every condition: text, and numbers as JSON takes them.

    Total times are of the flights that both finish: the same drones, batteries and gusts. Intervals
    of 95% are over the drones. The other numbers are of all flights.
    """
    lines, notes, numbers = [], [], dict[str, Any]({name: {} for name in KINDS})
    for pair in zip(e2e, indi, strict=True):
        cells, label = [], pair[0].condition
        for name, row, both in zip(KINDS, pair, common(*pair), strict=True):
            cells += [interval_text(both.drone_totals), f"{row.finished}/{row.runs}"]
            totals = [*interval(both.drone_totals), *both.drone_totals.tolist()]
            mean, width, *each = (x if np.isfinite(x) else None for x in totals)
            of_row = {"finished": row.finished, "runs": row.runs, "crashes": row.ends}
            of_both = {"mean": mean, "interval": width, "each plant": each}
            numbers[name][label] = of_both | {"both finish": both.finished} | of_row
            if row.ends:
                ends = ", ".join(f"{reason} {count}" for reason, count in row.ends.items())
                notes.append(f"{name}, {label}, early ends: {ends}")
        lines.append([label, *cells])
        if both.finished < row.runs:
            count = int(np.isfinite(both.drone_totals).sum())
            text = f"both finish {both.finished} of {row.runs} flights"
            notes.append(f"{label}: {text}, on {count} of {row.drones} drones")
    notes.append(lead(e2e[0].condition, e2e[0], indi[0]))
    title = f"{e2e[0].drones} drawn drones: total time of the flights that both finish, s, with 95%"
    title += "\nintervals over the drones; finished: of all flights"
    table = Table(["", "E2E", "finished", "INDI", "finished"], lines, notes)
    return f"{title}\n{table.format()}", numbers
