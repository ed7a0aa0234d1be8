"""From a policy and its race to integers, their proof and the emitted sources."""

import dataclasses
import hashlib
import itertools
import textwrap
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.export import flights
from quadjax.export.battery_tables import BatteryTables, make_battery
from quadjax.export.emit import (
    Provenance,
    emit_battery,
    emit_estimator,
    emit_network,
    emit_paparazzi,
    emit_race,
)
from quadjax.export.estimator_tables import (
    CUTOFF,
    SAMPLE_RATE,
    EstimatorTables,
    make_estimator,
)
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork, convert
from quadjax.export.flights import Rollouts
from quadjax.export.indiflight import emit_indiflight
from quadjax.export.proof import Proof, prove
from quadjax.export.qjp.autopilots import emit_crazyflie, emit_px4
from quadjax.export.qjp.emit import emit_loader
from quadjax.export.qjp.policy import make_qjp, qjp_bytes
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import RaceTables, make_tables, track_ranges
from quadjax.export.render import identifier, is_reserved, shared_symbols
from quadjax.export.targets import (
    AS_FILE,
    CRAZYFLIE,
    DEFAULT_TARGET,
    INDIFLIGHT,
    PAPARAZZI,
    PX4,
    TARGETS,
    Target,
    has_estimator,
)
from quadjax.policy.file import Policy
from quadjax.race.observations import HIGHEST_RPM
from quadjax.vehicle.battery import middle_limit

COMMENT_WIDTH = 96
LONGEST_NAME = 60
PLACEHOLDER = "placeholder"  # a prefix that no symbol of the C code contains


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of an export; see ``convert.export_c``. The report keeps them."""

    name: str  # prefix of every C symbol
    ranges: dict[str, float] = dataclasses.field(default_factory=dict)
    sample_rate: float = SAMPLE_RATE
    cutoff: float = CUTOFF
    allow_unfinished: bool = False
    allow_other_race: bool = False
    target: str = DEFAULT_TARGET


@dataclasses.dataclass(frozen=True)
class Converted:
    """A policy and its race as integers: everything that the files are made from."""

    policy: Policy
    network: FixedNetwork
    proof: Proof
    race: RaceTables
    estimator: EstimatorTables | None  # None for a vehicle without external disturbances
    battery: BatteryTables | None  # None where the highest propeller speed is not observed
    rollouts: Rollouts  # evenly spread rows of the simulated flights
    own: OwnRace
    origin: Provenance
    residual_hash: str  # SHA-256 of the residual file; empty without one
    options: Options

    @property
    def target(self) -> Target:
        """Processor and autopilot."""
        return TARGETS[self.options.target]

    def sources(self) -> dict[str, str]:
        """Every emitted C file and header, by its path in the folder."""
        if self.target.autopilot in AS_FILE:
            return self._loaded()
        network, origin, rollouts = self.network, self.origin, self.rollouts
        files = emit_network(network, origin, rollouts.observations)
        files |= emit_race(self.race, network, origin, rollouts.states, rollouts.targets)
        if self.estimator is not None:
            files |= emit_estimator(self.estimator, network, origin, self.residual_hash)
        if self.battery is not None:
            files |= emit_battery(self.battery, network, origin)
        if self.target.autopilot == PAPARAZZI:
            files |= emit_paparazzi(network, origin, self.race, self.estimator, self.battery)
        if self.target.autopilot == INDIFLIGHT:
            files |= emit_indiflight(files, network, origin, self.race, self.own, self.policy)
        return files

    def _loaded(self) -> dict[str, str]:
        """The C that loads the policy as a file, and its autopilot's."""
        autopilot, own = self.target.autopilot, (self.network, self.race)
        files = emit_loader()
        if autopilot == PX4:
            files |= emit_px4(*own)
        if autopilot == CRAZYFLIE:
            (data,) = self.binaries().values()
            files |= emit_crazyflie(self.origin.name, data, *own, self.own.time_step)
        return files

    def binaries(self) -> dict[str, bytes]:
        """Every other emitted file, by its path in the folder: the policy as a ``.qjp`` file."""
        if self.target.autopilot not in AS_FILE:
            return {}
        rows, step = self.rollouts, self.own.time_step
        parts = (self.network, self.race, self.origin.policy_hash, step)
        tests = (rows.observations, rows.states, rows.targets)
        return {f"{self.origin.name}.qjp": qjp_bytes(make_qjp(self.origin.name, *parts, *tests))}


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def convert_policy(
    policy: Policy,
    own: OwnRace,
    options: Options,
    file: str,
    path: Path,
    rollouts: Rollouts | None = None,
) -> Converted:
    """Convert and prove a policy, and simulate its own race.

    Args:
        policy: the policy.
        own: its race.
        options: of the export.
        file: name of the policy file, for the headers.
        path: of the policy file.
        rollouts: those of an earlier conversion, which is then repeated without simulating.

    Raises:
        InputError: see ``convert.export_c``.
    """
    network = convert(policy, track_ranges(policy.layout, own.params.track) | options.ranges)
    proof = prove(network, policy)
    if rollouts is None:
        rollouts = flights.simulate(own)
        if not options.allow_unfinished:
            flights.check_finished(rollouts.laps, own, file)
        network.box.check(rollouts.observations)
        rollouts = rollouts.thinned()
    vehicle, estimator = own.params.vehicle, None
    if network.model.name == "motor" and has_estimator(options.target):
        numbers = (options.sample_rate, options.cutoff)
        estimator = make_estimator(vehicle.constants, vehicle.residual, *numbers)
    return Converted(
        policy=policy,
        network=network,
        proof=proof,
        race=make_tables(network.box, policy, own.choices, own.params),
        estimator=estimator,
        battery=_battery(policy, own, options),
        rollouts=rollouts,
        own=own,
        origin=_origin(policy, own, options.name, file, sha256(path)),
        residual_hash=sha256(own.residual) if estimator and own.residual else "",
        options=options,
    )


def _battery(policy: Policy, own: OwnRace, options: Options) -> BatteryTables | None:
    """The estimator of the highest propeller speed, for a policy that observes it."""
    if HIGHEST_RPM not in policy.layout:
        return None
    assert own.params.battery is not None
    first = float(middle_limit(own.params.battery))
    return make_battery(own.params.vehicle.constants, first, options.sample_rate)


def check_symbols(converted: Converted) -> None:
    """Raise an ``InputError`` for a name that makes two symbols of the C code identical."""
    origin = dataclasses.replace(converted.origin, name=PLACEHOLDER)
    sources = dataclasses.replace(converted, origin=origin).sources()
    shared = shared_symbols(sources.values(), converted.origin.name, PLACEHOLDER)
    if shared:
        raise InputError(
            f"--name {converted.origin.name}: the C code has another symbol {shared[0]}; "
            "choose another name"
        )


def symbol_name(name: str | None, file: str) -> str:
    """The prefix of every C symbol: the requested one, or the policy file's name."""
    name = name if name is not None else identifier(Path(file).stem)
    if is_reserved(name):
        raise InputError(
            f"--name {name}: is a C keyword or a name of the C library; choose another"
        )
    if identifier(name) != name or len(name) > LONGEST_NAME:
        raise InputError(
            f"--name {name!r}: expected a lower-case C identifier of at most {LONGEST_NAME} letters"
        )
    return name


def _origin(policy: Policy, own: OwnRace, name: str, file: str, policy_hash: str) -> Provenance:
    """Name, hash and the comment at the top of each file."""
    stated = {k: v for k, v in policy.source.items() if v is not None and not isinstance(v, dict)}
    source = ", ".join(f"{key}={value}" for key, value in stated.items())
    facts = (
        f"Policy   {file}, SHA-256 {policy_hash}",
        f"Source   {source or 'not stated in the policy file'}",
        f"Format   quadjax fixed point, version {FORMAT_VERSION}; deterministic (mean) actions",
        f"Track    {own.track}; vehicle {own.vehicle}",
    )
    lines = [textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts]
    return Provenance(name, policy_hash, tuple(itertools.chain(*lines)), source or file)
