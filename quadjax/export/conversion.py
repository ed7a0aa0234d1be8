"""From a policy and its race to integers, their proof and the emitted sources."""

import dataclasses
import hashlib
import itertools
import textwrap
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.export import flights
from quadjax.export.emit import (
    Provenance,
    emit_estimator,
    emit_network,
    emit_paparazzi,
    emit_race,
)
from quadjax.export.estimator_tables import EstimatorTables, make_estimator
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork, convert
from quadjax.export.flights import Rollouts
from quadjax.export.proof import Proof, prove
from quadjax.export.race_source import OwnRace, own_race
from quadjax.export.race_tables import RaceTables, make_tables
from quadjax.export.render import identifier, is_reserved
from quadjax.policy.file import Policy
from quadjax.vehicle.residual_file import located

KEPT_ROWS = 20_000  # rows of the simulated flights that are kept for the verification
COMMENT_WIDTH = 96
RESIDUAL_FILE = "residual.npz"  # in an exported folder
LONGEST_NAME = 60


@dataclasses.dataclass(frozen=True)
class Request:
    """Arguments of a conversion; see ``convert.export_c``."""

    policy: Path
    folder: Path
    ranges: dict[str, float] = dataclasses.field(default_factory=dict)
    name: str | None = None
    track: str | None = None
    config: Path | str | Config | None = None
    sample_rate: float = 512.0
    cutoff: float = 8.0
    allow_unfinished: bool = False


@dataclasses.dataclass(frozen=True)
class Converted:
    """A policy and its race as integers: everything that the files are made from."""

    policy: Policy
    network: FixedNetwork
    proof: Proof
    race: RaceTables
    estimator: EstimatorTables | None
    rollouts: Rollouts  # evenly spread rows of the simulated flights
    own: OwnRace
    origin: Provenance
    residual_hash: str  # SHA-256 of the residual file; empty without one


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def convert_policy(request: Request) -> Converted:
    """Convert and prove a policy, and simulate its own race.

    Raises:
        InputError: see ``convert.export_c``.
    """
    policy = Policy.load(request.policy)
    network = convert(policy, request.ranges)
    proof = prove(network, policy)
    own = own_race(policy, request.policy, request.config, request.track)
    found = flights.simulate(own, policy)
    if not request.allow_unfinished:
        flights.check_finished(found.laps, own, request.policy.name)
    flights.check_box(network.box, found.observations)
    rows = np.linspace(0, len(found.states) - 1, min(KEPT_ROWS, len(found.states))).astype(int)
    kept = Rollouts(
        found.observations[rows], found.states[rows], found.targets[rows], found.laps, found.steps
    )
    return _complete(request, request.policy.name, policy, network, proof, own, kept)


def convert_again(request: Request, file: str, rollouts: Rollouts) -> Converted:
    """Repeat the conversion of an exported folder, without simulating.

    Args:
        request: of the files in the folder.
        file: name of the policy file that was exported.
        rollouts: as kept in the folder.

    Raises:
        InputError: see ``convert.export_c``.
    """
    policy = Policy.load(request.policy)
    network = convert(policy, request.ranges)
    residual = request.folder / RESIDUAL_FILE
    own = own_race(policy, request.policy, request.config, None, residual)
    return _complete(request, file, policy, network, prove(network, policy), own, rollouts)


def _complete(
    request: Request,
    file: str,
    policy: Policy,
    network: FixedNetwork,
    proof: Proof,
    own: OwnRace,
    rollouts: Rollouts,
) -> Converted:
    """The integers of the race and of the estimator, and all of it together."""
    vehicle, residual = own.params.vehicle, own.config.vehicle.residual
    estimator = None  # a rate-level policy does not observe the disturbances
    if own.choices.model.balance is not None:
        numbers = (request.sample_rate, request.cutoff)
        estimator = make_estimator(vehicle.constants, vehicle.residual, *numbers)
    return Converted(
        policy=policy,
        network=network,
        proof=proof,
        race=make_tables(network, policy, own.params.track, own.choices.gate_test == "world_box"),
        estimator=estimator,
        rollouts=rollouts,
        own=own,
        origin=_origin(request, file, policy, own),
        residual_hash=sha256(located(residual)) if estimator and residual else "",
    )


def symbol_name(request: Request, file: str) -> str:
    """The prefix of every C symbol: the requested one, or the policy file's name."""
    name = request.name if request.name is not None else identifier(Path(file).stem)
    if is_reserved(name):
        raise InputError(
            f"--name {name}: is a C keyword or a name of the C library; choose another"
        )
    if identifier(name) != name or len(name) > LONGEST_NAME:
        raise InputError(
            f"--name {name!r}: expected a lower-case C identifier of at most {LONGEST_NAME} letters"
        )
    return name


def _origin(request: Request, file: str, policy: Policy, own: OwnRace) -> Provenance:
    """Name, hash and the comment at the top of each file."""
    policy_hash = sha256(request.policy)
    stated = {k: v for k, v in policy.source.items() if v is not None and not isinstance(v, dict)}
    source = ", ".join(f"{key}={value}" for key, value in stated.items())
    track, vehicle = (
        part.name or Path(part.file).name for part in (own.config.track, own.config.vehicle)
    )
    facts = (
        f"Policy   {file}, SHA-256 {policy_hash}",
        f"Source   {source or 'not stated in the policy file'}",
        f"Format   quadjax fixed point, version {FORMAT_VERSION}; deterministic (mean) actions",
        f"Track    {track}; vehicle {vehicle}",
    )
    lines = [textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts]
    name = symbol_name(request, file)
    return Provenance(name, policy_hash, tuple(itertools.chain(*lines)), source or file)


def sources(converted: Converted) -> dict[str, str]:
    """Every emitted C file and header, by its path in the folder."""
    network, origin, rollouts = converted.network, converted.origin, converted.rollouts
    files = emit_network(network, origin, rollouts.observations)
    motor = network.vehicle == "motor"
    files |= emit_race(converted.race, origin, motor, rollouts.states, rollouts.targets)
    if converted.estimator is not None:
        files |= emit_estimator(converted.estimator, origin, converted.residual_hash)
    return files | emit_paparazzi(network, origin)
