"""Races of an autopilot on a simulated drone, from a folder of C or a config to files."""

import contextlib
import dataclasses
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_text
from quadjax.core.provenance import provenance
from quadjax.evaluation.rows import Row
from quadjax.evaluation.table import counted, lap_table
from quadjax.export.verify.folder import Inputs, read_inputs
from quadjax.flights.files import save
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import plan_race, race_config
from quadjax.policy.file import Policy
from quadjax.policy.pilot import fit_race
from quadjax.race.laps import Laps
from quadjax.sil.faults import Faults
from quadjax.sil.fly import Race, Timing, fly
from quadjax.sil.peer import (
    ADDRESS,
    CONNECT_SECONDS,
    START_SECONDS,
    Peer,
    greeted,
    listening,
    running,
)
from quadjax.sil.plant_world import PlantWorld
from quadjax.sil.simulator_world import simulator_world
from quadjax.sil.source import check_byte_order, header_text, label_of, write_sources
from quadjax.sil.worlds import World, command_kind
from quadjax.training.build import untrained_policy

ON_PLANT = ("motor", "rate")  # vehicle models that the stand-in plant has
STATES_FILE, NUMBERS_FILE, TABLE_FILE, HEADER_FILE = (
    *("states.npz", "sil.json", "table.txt", "message.h"),
)
FILES = (STATES_FILE, NUMBERS_FILE, TABLE_FILE, HEADER_FILE, "flight.html")


@dataclasses.dataclass(frozen=True)
class Setting:
    """What flies, on what, and how.

    Attributes:
        source: folder of ``quadjax export``; without a process of ours also a config.
        plant: the stand-in plant; None: the simulator of the race.
        listen: address at which a user's autopilot connects; None: the exported C is started.
        laps: of a race; ``evaluate.laps`` of the config if not given.
        runs: number of races, one after the other.
        seed: of drones and faults; a race has the seed plus its number.
        timing: lock-step, or a speed.
        faults: of the link.
        race: config of an exported folder's race, named by the user; the folder's if not given.
    """

    source: Path
    plant: PlantConfig | None
    listen: tuple[str, int] | None = None
    laps: int | None = None
    runs: int = 1
    seed: int = 0
    timing: Timing = Timing()
    faults: Faults = Faults()
    race: Path | str | None = None


@dataclasses.dataclass(frozen=True)
class Flown:
    """Races that have been flown."""

    setting: Setting
    config: Config
    world: World
    autopilot: str
    sources: str  # the C that flies; empty for an autopilot of the user
    races: list[Race]

    @property
    def laps(self) -> Laps:
        """Of all races."""
        parts = [race.laps for race in self.races]
        return Laps(
            np.concatenate([part.lap_times for part in parts]),
            tuple(crash for part in parts for crash in part.crashes),
            np.concatenate([part.seconds for part in parts]),
            parts[0].time_limit,
        )

    @property
    def counts(self) -> dict[str, int]:
        """Of all races."""
        return dict(sum((Counter(race.counts) for race in self.races), Counter()))

    def text(self) -> str:
        """The lap table, the reasons for early ends, and the counts."""
        speed = self.setting.timing.speed
        how = "lock-step" if speed is None else f"{speed:g} times real time"
        label = f"{self.autopilot}, {counted(len(self.races), 'run')}"
        lines = [
            lap_table([Row(label, self.laps)]).format(),
            f"C that flies: {self.sources}" if self.sources else "",
            f"drone: {self.world.name}, {1.0 / self.world.step:g} Hz, {how}",
            *(f"{name}: {number:,}" for name, number in self.counts.items()),
        ]
        return "\n".join(line for line in lines if line)

    def to_json(self) -> dict[str, Any]:
        """Laps as of ``quadjax evaluate``, counts, and provenance."""
        setting = self.setting
        return self.laps.to_json() | {
            "autopilot": self.autopilot,
            "sources": self.sources or None,
            "drone": self.world.name,
            "speed": setting.timing.speed,
            "counts": self.counts,
            "faults": dataclasses.asdict(setting.faults) if setting.faults else None,
            "provenance": provenance(self.config, seed=setting.seed),
            "plant": setting.plant.model_dump(mode="json") if setting.plant else None,
        }

    def write(self, folder: Path) -> None:
        """Write states, numbers, table and the header of the messages."""
        flights, record = [race.flight for race in self.races], self.to_json()
        if any(len(flight.time) for flight in flights):
            save(flights, folder / STATES_FILE, **record)
        write_json(folder / NUMBERS_FILE, record)
        write_text(folder / TABLE_FILE, self.text() + "\n")
        write_text(folder / HEADER_FILE, header_text())


def make_world(config: Config, policy: Policy, plant: PlantConfig | None, laps: int) -> World:
    """The drone that a policy's race needs.

    Args:
        config: of the race.
        policy: whose model and limits the commands have.
        plant: the stand-in plant; None: the simulator of the race.
        laps: of a race.

    Raises:
        InputError: a vehicle model that the plant lacks, or that has no messages.
    """
    if plant is None:
        choices, params = fit_race(*race_of(config), policy)
        command_kind(choices.model)
        return simulator_world(choices, params, laps)
    if policy.vehicle not in ON_PLANT:
        raise InputError(
            f"the stand-in plant has no vehicle model {policy.vehicle!r}, allowed: "
            f"{', '.join(ON_PLANT)}; --simulator flies the race's own simulator"
        )
    return PlantWorld(plan_race(config, plant, policy, lap_count=laps, runs=1, recorded=1))


def fly_all(
    setting: Setting, stop: threading.Event, report: Callable[[str], None] = lambda line: None
) -> Flown:
    """Fly all races.

    Args:
        setting: what flies.
        stop: ends the race under way; the record so far is kept.
        report: called with the progress.

    Raises:
        InputError: bad input, no compiler, a port that is taken, or an autopilot that does not
            answer before its first race. One that is gone later is in the last race.
    """
    check_byte_order()
    enable_compilation_cache()
    inputs, config, policy = _read(setting)
    laps = setting.laps or config.evaluate.laps
    world = make_world(config, policy, setting.plant, laps)
    races: list[Race] = []
    with _autopilot(setting, inputs, world, stop, report) as (peer, names):
        for run in range(setting.runs):
            text = f"run {run + 1} of {setting.runs}"
            report(text)

            def say(seconds: float, text: str = text) -> None:
                report(f"{text}: {seconds:.0f} s flown")

            options = (setting.faults, setting.timing, setting.seed, run, stop, say)
            races.append(fly(world, peer, *options, config.track.gates))
            if stop.is_set() or races[-1].gone:
                break
    return Flown(setting, config, world, *names, races)


def _compile(world: World, report: Callable[[str], None]) -> None:
    """Compile the drone, before an autopilot waits for it."""
    report("compiling")
    world.advance(world.begin(0), world.ranges()[0].astype(np.float32))


def _read(setting: Setting) -> tuple[Inputs | None, Config, Policy]:
    """The inputs of an exported folder; or the race of a config, with an untrained policy."""
    if setting.source.is_dir() or setting.listen is None:
        inputs = read_inputs(setting.source, setting.race)
        return inputs, inputs.config, inputs.policy
    config = load_config(setting.source)
    config = race_config(config, untrained_policy(config)) if setting.plant else config
    return None, config, untrained_policy(config)


@contextlib.contextmanager
def _autopilot(
    setting: Setting,
    inputs: Inputs | None,
    world: World,
    stop: threading.Event,
    report: Callable[[str], None],
) -> Iterator[tuple[Peer, tuple[str, str]]]:
    """The autopilot of a setting, connected; its name, and the C files that fly."""
    kind = command_kind(world.model)
    if setting.listen is not None:
        with listening(*setting.listen) as own:
            _compile(world, report)
            host, port = own.getsockname()
            report(f"waiting for an autopilot at {host}:{port}")
            with greeted(own, kind, CONNECT_SECONDS, stop) as peer:
                yield peer, ("your autopilot", "")
        return
    assert inputs is not None
    with tempfile.TemporaryDirectory() as work, listening(ADDRESS, 0) as own:
        sources = write_sources(setting.source, inputs, 1.0 / world.step, Path(work))
        report("building the C")
        program = sources.build(Path(work))
        label = label_of(program, setting.source)
        _compile(world, report)
        with running(program, own.getsockname()[1]):
            with greeted(own, kind, START_SECONDS, stop) as peer:
                yield peer, (label, sources.text)
