"""Races of exported C on a simulated drone, from a folder of C or a policy to files."""

import contextlib
import dataclasses
import tempfile
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import provenance
from quadjax.evaluation.rows import Row, concatenate
from quadjax.evaluation.table import counted, lap_table
from quadjax.export.conversion import Converted, Options, convert_policy
from quadjax.export.convert import convert_file
from quadjax.export.folder import read_folder
from quadjax.export.names import symbol_name
from quadjax.export.targets import DEFAULT_TARGET
from quadjax.fitting.flight_log import write_flight
from quadjax.flights.files import save
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import plan_race
from quadjax.policy.file import Policy
from quadjax.policy.pilot import adapt_race
from quadjax.policy.race import warn_of_other_race
from quadjax.race.laps import Laps
from quadjax.sil.autopilot import Autopilot, ExportedC
from quadjax.sil.betaflight import betaflight_in_race
from quadjax.sil.betaflight_firmware import find_firmware
from quadjax.sil.drones import SimulatedDrone, plant_drone, simulator_drone
from quadjax.sil.faults import Faults
from quadjax.sil.fly import FlightResult, fly

ON_PLANT = ("motor", "rate")  # vehicle models that a plant has
STATES_FILE = "states.npz"
FILES = (STATES_FILE, "sil.json", "table.txt", "flight.html", "log_*.csv")
SAME_LOOP = 0.03  # largest relative difference of the loop rates of plant and autopilot
MEANINGS = {  # of counts
    "autopilot: late calls": "calls without a new state",
    "autopilot: nan calls": "calls with a number that is not finite",
    "steps without a state": "steps with commands of 0",
    "autopilot: outside steps": "steps with an input outside its range",
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """What flies, on what, and how."""

    source: Path  # folder of ``quadjax export``, or a policy file
    plant: PlantConfig | None  # None: the simulator of the race
    laps: int | None = None  # of a race; ``evaluate.laps`` of the config if not given
    runs: int = 1  # number of races, one after the other
    seed: int = 0  # of drones and faults; a race has the seed plus its number
    faults: Faults = Faults()  # of the link
    # config of the race, named by the user; that of the folder or policy if not given
    race: Path | str | None = None
    target: str = DEFAULT_TARGET  # processor and autopilot for which a policy file is converted
    # settings of Betaflight's firmware, NAME=VALUE, which flies under the commands of the C
    betaflight: tuple[str, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Flown:
    """Races that have been flown."""

    setting: Setting
    config: Config
    drone: str  # its name and control rate
    autopilot: str
    sources: str  # the C that flies
    races: list[FlightResult]

    @property
    def laps(self) -> Laps:
        """Of all races."""
        return concatenate([race.laps for race in self.races])

    @property
    def counts(self) -> dict[str, int]:
        """Of all races."""
        return dict(sum((Counter(race.counts) for race in self.races), Counter()))

    def text(self) -> str:
        """The lap table, what flew, and the counts: at most eight lines."""
        counts = self.counts
        steps = counts.pop("steps", 0)
        label = f"{self.autopilot}, {counted(len(self.races), 'run')}"
        lines = [
            lap_table([Row(label, self.laps)]).format(),
            f"flies: {self.sources}; drone: {self.drone}, {steps:,} steps",
        ]
        states = [f"{n:,} {key[7:]}" for key, n in counts.items() if key.startswith("states ")]
        pilot = [f"{counts[key]:,} {text}" for key, text in MEANINGS.items() if key in counts]
        parts = [f"states: {', '.join(states)}"] * bool(states)
        outside = sorted({name for race in self.races for name in race.outside})
        parts += [f"pilot: {', '.join(pilot)}"] * bool(pilot)
        lines += ["; ".join(parts) + f" ({', '.join(outside)})" * bool(outside)]
        return "\n".join(line for line in lines if line)

    def to_json(self) -> dict[str, Any]:
        """Laps as of ``quadjax evaluate``, counts, and provenance."""
        setting = self.setting
        return self.laps.to_json() | {
            "autopilot": self.autopilot,
            "sources": self.sources,
            "drone": self.drone,
            "counts": self.counts,
            "outside": sorted({name for race in self.races for name in race.outside}),
            "settings": list(setting.betaflight) if setting.betaflight is not None else None,
            "faults": dataclasses.asdict(setting.faults) if setting.faults else None,
            "provenance": provenance(self.config, seed=setting.seed),
            "plant": setting.plant.model_dump(mode="json") if setting.plant else None,
        }

    def write(self, folder: Path) -> None:
        """Write ``FILES`` but for the page: states, logs, numbers, table."""
        flights, record = [race.flight for race in self.races], self.to_json()
        if any(len(flight.time) for flight in flights):
            save(flights, folder / STATES_FILE, **record)
        for number, flight in enumerate(flights):
            if "rate_command" in flight.signals and len(flight.time):
                write_flight(folder / f"log_{number}.csv", flight)
        write_json(folder / "sil.json", record)
        write_text(folder / "table.txt", self.text() + "\n")


def make_drone(
    config: Config, policy: Policy, plant: PlantConfig | None, laps: int
) -> SimulatedDrone:
    """The drone that the race of a policy needs, with the policy's model and limits.

    On a plant, or, without one, in the simulator of the race.

    Raises:
        InputError: a vehicle model that the plant lacks.
    """
    if plant is None:
        return simulator_drone(*adapt_race(*make_race(config), policy), laps)
    if policy.vehicle not in ON_PLANT:
        raise InputError(
            f"a plant has no vehicle model {policy.vehicle!r}, allowed: "
            f"{', '.join(ON_PLANT)}; --simulator flies the race's own simulator"
        )
    plan = plan_race(config, plant, policy, lap_count=laps, runs=1, recorded=1)
    return plant_drone(plan, plant.name)


def fly_all(
    setting: Setting, stop: threading.Event, report: Callable[[str], None] = lambda line: None
) -> Flown:
    """Fly all races; ``stop`` ends the race under way, and the record so far is kept.

    Raises:
        InputError: bad input, or no compiler.
        KeyboardInterrupt: stopped before the first step.
    """
    enable_compilation_cache()
    if setting.betaflight is not None:
        find_firmware()
    with tempfile.TemporaryDirectory() as work:
        return _fly_all(setting, Path(work), stop, report)


def _fly_all(
    setting: Setting, work: Path, stop: threading.Event, report: Callable[[str], None]
) -> Flown:
    converted, setting = _converted(setting)
    config = converted.race.config
    warn_of_other_race(converted.policy, config, converted.file)
    laps = setting.laps or config.evaluate.laps
    report("building the C")
    with contextlib.ExitStack() as stack:
        autopilot: Autopilot
        if setting.betaflight is not None:
            in_race = betaflight_in_race(converted, work, laps, setting.betaflight)
            drone, autopilot = stack.enter_context(in_race)
        else:
            drone = make_drone(config, converted.policy, setting.plant, laps)
            autopilot = ExportedC(converted, work, 1.0 / drone.step)
        return _fly_races(setting, config, drone, autopilot, stop, report)


def _fly_races(
    setting: Setting,
    config: Config,
    drone: SimulatedDrone,
    autopilot: Autopilot,
    stop: threading.Event,
    report: Callable[[str], None],
) -> Flown:
    report("compiling")
    drone.advance(drone.begin(0), drone.ranges()[0].astype(np.float32))
    races: list[FlightResult] = []
    for run in range(setting.runs):
        text = f"run {run + 1} of {setting.runs}"
        report(text)

        def say(seconds: float, text: str = text) -> None:
            report(f"{text}: {seconds:.0f} s flown")

        how = (setting.faults, setting.seed + run, stop, say)
        flown = fly(drone, autopilot, *how, config.track.gates, f"run {run + 1}")
        record = flown.flight.of_drone(drone.constants())
        races.append(dataclasses.replace(flown, flight=record))
        if stop.is_set():
            break
    if stop.is_set() and not len(races[0].flight.time):
        raise KeyboardInterrupt
    name = f"{drone.name}, {1.0 / drone.step:g} Hz"
    return Flown(setting, config, name, autopilot.label, autopilot.files, races)


def _converted(setting: Setting) -> tuple[Converted, Setting]:
    """The policy of a setting as C, and the setting with the plant at the rate of its estimators.

    Those of a policy file are made for the rate of the drone's control loop. A plant runs at the
    rate of an exported folder's, if that is within ``SAME_LOOP`` of its own.
    """
    plant = setting.plant
    if setting.source.is_dir():
        converted = read_folder(setting.source, setting.race)
        rate = converted.in_c.sample_rate
        if plant is not None and rate and abs(rate / plant.control_rate - 1.0) <= SAME_LOOP:
            ratio = rate / plant.control_rate
            rates = {name: ratio * getattr(plant, name) for name in ("sample_rate", "control_rate")}
            setting = dataclasses.replace(setting, plant=plant.replace(**rates))
        return converted, setting
    name, named = symbol_name(None, setting.source.name), setting.race is not None
    options = Options(name, target=setting.target, allow_other_race=named)
    converted = convert_file(setting.source, options, setting.race)
    if converted.in_c.sample_rate is not None:
        rate = 1.0 / converted.race.time_step if plant is None else plant.control_rate
        options = dataclasses.replace(options, sample_rate=rate)
        parts = (converted.policy, converted.race, options, converted.file, setting.source)
        converted = convert_policy(*parts)
    return converted, setting
