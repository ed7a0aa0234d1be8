"""E2E and INDI in the simulator and on the stand-in plant: flights and numbers."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.evaluation.tables import Row, lap_row
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import Flights, fly_plan
from quadjax.plant.races import plan_race, race_config
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps, Trace
from quadjax.studies.ablation import RESIDUAL, Variant
from quadjax.studies.drawn_plants import OnPlants, conditions, drawn

FLIGHTS = 5  # number of flights of the paper's mean and best
Report = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Contender:
    """A policy to compare."""

    name: str  # "E2E" | "INDI"
    policy: Policy
    file: str


@dataclasses.dataclass(frozen=True)
class Compared:
    """One contender in the simulator and on the plant."""

    contender: Contender
    simulated: Laps
    trace: Trace
    on_plant: Flights


@dataclasses.dataclass(frozen=True)
class Setting:
    """Race, plant and number of flights of a comparison, and of drawn plants."""

    race: Config
    plant: PlantConfig
    laps: int = 6
    runs: int = 100
    seed: int = 0
    plants: int = 10
    deterministic: bool = True  # apply the mean action


def contender(name: str, file: str) -> Contender:
    """A policy file as a contender.

    Raises:
        InputError: a file that cannot be read.
    """
    return Contender(name, Policy.load(file), file)


def read_contenders(e2e: Path, indi: Path) -> tuple[Contender, Contender]:
    """The policy files of E2E and INDI.

    Raises:
        InputError: a file that cannot be read, or a policy for another vehicle.
    """
    pair = contender("E2E", str(e2e)), contender("INDI", str(indi))
    for side, kind in zip(pair, ("motor", "rate"), strict=True):
        if side.policy.vehicle != kind:
            raise InputError(
                f"{side.file}: a policy for the {side.policy.vehicle} vehicle, expected {kind} for "
                f"--{side.name.lower()}"
            )
    return pair


def compare_one(setting: Setting, own: Contender, report: Report) -> Compared:
    """Evaluate one contender in the simulator and on the plant."""
    report(f"{own.name}: simulator")
    simulated, trace = pilot.fly_policy(
        *race_of(race_config(setting.race, own.policy)),
        own.policy,
        laps=setting.laps,
        runs=setting.runs,
        seed=setting.seed,
        deterministic=setting.deterministic,
        trace=True,
        name=own.file,
    )
    report(f"{own.name}: stand-in plant")
    return Compared(own, simulated, trace, fly(setting, setting.plant, own))


def fly(setting: Setting, plant: PlantConfig, own: Contender) -> Flights:
    """A contender's flights on a plant, with the noise of ``setting.seed``."""
    options = {"lap_count": setting.laps, "runs": setting.runs, "recorded": FLIGHTS}
    options["deterministic"] = setting.deterministic
    plan = plan_race(setting.race, plant, own.policy, own.file, **options)
    return fly_plan(plan, setting.seed)


def first(laps: Laps, count: int = FLIGHTS) -> Laps:
    """The first runs only."""
    return Laps(laps.lap_times[:count], laps.crashes[:count], laps.seconds[:count], laps.time_limit)


def rows(compared: Compared) -> list[Row]:
    """The paper's rows of one contender: simulated, and five flights on the plant.

    ``finished`` counts all runs.
    """
    name = compared.contender.name
    on_plant = compared.on_plant.laps
    count = min(FLIGHTS, len(on_plant.crashes))
    five = lap_row(f"{name} stand-in plant, mean of {count}", first(on_plant))
    five = dataclasses.replace(five, finished=on_plant.finished, runs=len(on_plant.crashes))
    return [lap_row(f"{name} simulated", compared.simulated), five]


def fly_drawn(setting: Setting, plant: PlantConfig, own: Contender) -> OnPlants:
    """A contender's flights on drawn plants, which share the runs equally.

    Each plant has its own seed of batteries, gusts and sensors, the same for every contender.

    Raises:
        InputError: a number of runs that is no multiple of the number of plants.
    """
    if setting.runs % setting.plants:
        raise InputError(f"runs is {setting.runs}, allowed: multiples of plants ({setting.plants})")
    share = dataclasses.replace(setting, runs=setting.runs // setting.plants)
    return OnPlants(
        tuple(
            fly(dataclasses.replace(share, seed=setting.seed + number), one, own).laps
            for number, one in enumerate(drawn(plant, setting.plants))
        )
    )


def fly_conditions(
    setting: Setting, own: Contender, report: Report, only: Sequence[str] | None = None
) -> dict[str, OnPlants]:
    """A contender under each of ``conditions`` of the drawn plants, or those that ``only`` names.

    See ``quadjax.studies.drawn_plants``.
    """
    result = {}
    for label, plant in conditions(setting.plant).items():
        if only is None or label in only:
            report(f"{own.name}: {setting.plants} plants, {label}")
            result[label] = fly_drawn(setting, plant, own)
    return result


def fly_variant(setting: Setting, variant: Variant, folder: Path, report: Report) -> Laps:
    """One line of the ablation."""
    report(f"ablation: {variant.group} {variant.label}")
    vehicle = setting.race.vehicle.replace(residual=RESIDUAL if variant.residual else None)
    own = dataclasses.replace(setting, race=setting.race.replace(vehicle=vehicle))
    plant = setting.plant.replace(disturbance=variant.disturbance)
    return fly(own, plant, contender("E2E", str(variant.path(folder)))).laps


def limit_fractions(setting: Setting, own: Compared) -> tuple[float, float | None]:
    """Fraction of rpm commands at a limit: on the plant, and simulated (None without motors)."""
    constants = setting.race.vehicle.with_model("motor").constants

    def fraction(command: np.ndarray, over: jax.Array) -> float:
        limited = (command <= constants["rpm_min"] + 1.0) | (command >= constants["rpm_max"] - 1.0)
        return float(limited[:, ~np.asarray(over)].mean())

    frames = own.on_plant.frames
    on_plant = fraction(np.stack(frames.rpm_command.components()), frames.over)
    if own.contender.policy.vehicle != "motor":
        return on_plant, None
    return on_plant, fraction(np.moveaxis(np.asarray(own.trace.command), 1, 0), own.trace.over)


def lead(e2e: Compared, indi: Compared) -> str:
    """E2E's lead over INDI in the simulator and on the plant as text; positive if E2E is faster."""
    worlds = {
        "simulated": (e2e.simulated, indi.simulated),
        "on the stand-in plant": (e2e.on_plant.laps, indi.on_plant.laps),
    }
    totals, firsts, later = [], [], []
    for world, both in worlds.items():
        for own, laps in zip((e2e, indi), both, strict=True):
            if not laps.finished:
                return f"E2E's lead over INDI: {own.contender.name} finished no run {world}"
        ahead = np.subtract(*(lap_row("", laps).laps for laps in reversed(both)))
        totals.append(f"{ahead.sum():+.2f} s {world}")
        firsts.append(f"{ahead[0]:+.2f}")
        later += [f"{ahead[1:].mean():+.2f}"] if len(ahead) > 1 else []
    text = f"E2E's lead over INDI: {', '.join(totals)}; first lap {' -> '.join(firsts)} s"
    return f"{text}, each later lap {' -> '.join(later)} s" if later else text
