"""From a policy and its race to integers, their proof and the files of an export."""

import dataclasses
import functools
import hashlib
import itertools
import re
import textwrap
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.export import flights
from quadjax.export.battery_tables import make_battery
from quadjax.export.cases import make_cases
from quadjax.export.estimator_tables import CUTOFF, SAMPLE_RATE, make_estimator
from quadjax.export.fixed import FixedNetwork, convert
from quadjax.export.flights import Rollouts
from quadjax.export.proof import Proof, prove
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import RaceTables, make_tables, track_ranges
from quadjax.export.render import (
    LONGEST_NAME,
    glue_header,
    identifier,
    policy_header,
    sizes_header,
)
from quadjax.export.targets import (
    DEFAULT_TARGET,
    RUNTIME,
    Target,
    check_target,
    observed_fields,
    runtime_files,
    target_of,
)
from quadjax.export.words import VERSION, FixedPolicy, pack
from quadjax.policy.file import Policy
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.vehicle.battery import middle_limit

COMMENT_WIDTH = 94


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
    fixed: FixedPolicy
    proof: Proof
    rollouts: Rollouts  # evenly spread rows of the simulated flights
    own: OwnRace
    facts: tuple[str, ...]  # lines about where the policy comes from
    options: Options

    @property
    def target(self) -> Target:
        """Processor and autopilot."""
        return target_of(self.options.target, self.policy.vehicle)

    @property
    def network(self) -> FixedNetwork:
        """The network as integers."""
        return self.fixed.network

    @property
    def race(self) -> RaceTables:
        """Observation and track as integers."""
        return self.fixed.race

    @property
    def name(self) -> str:
        """Name of the files."""
        return self.options.name

    @functools.cached_property
    def words(self) -> bytes:
        """The policy as words."""
        return pack(self.fixed)

    def files(self) -> dict[str, bytes]:
        """Every emitted file of the policy and its C, by its path in the folder."""
        target, header = self.target, policy_header(self.fixed, self.words, self.facts)
        texts = runtime_files(target)
        if target.as_file:
            texts[f"{target.folder}/qj_sizes.h"] = (RUNTIME / "qj_sizes.h").read_text("utf-8")
        else:
            texts[f"{target.folder}/qj_sizes.h"] = sizes_header(self.fixed)
            texts[f"{target.folder}/{self.name}.h"] = header
        if target.glue and not target.as_file:
            texts[f"{target.folder}/quadjax_policy.h"] = glue_header(self.fixed, self.own)
        return {name: text.encode() for name, text in texts.items()} | {
            f"{self.name}.qjp": self.words
        }


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
    race = make_tables(network.box, policy, own.choices, own.params)
    check_target(target_of(options.target, policy.vehicle), network, race)
    if rollouts is None:
        rollouts = flights.simulate(own)
        if not options.allow_unfinished:
            flights.check_finished(rollouts.laps, own, file)
        network.box.check(rollouts.observations)
        rollouts = rollouts.thinned()
    vehicle, observed = own.params.vehicle, observed_fields(race)
    estimator = battery = None
    if observed & set(DISTURBANCES) and network.model.name == "motor":
        numbers = (options.sample_rate, options.cutoff)
        estimator = make_estimator(vehicle.constants, vehicle.residual, *numbers)
    if HIGHEST_RPM in observed:
        assert own.params.battery is not None
        first = float(middle_limit(own.params.battery))
        battery = make_battery(vehicle.constants, first, options.sample_rate)
    tables = (network, race, estimator, battery)
    rows = (rollouts.observations, rollouts.states, rollouts.targets)
    policy_hash = sha256(path)
    fixed = FixedPolicy(
        options.name, *tables, policy_hash, own.time_step, make_cases(*tables, *rows)
    )
    facts = _facts(policy, own, file, policy_hash)
    return Converted(policy, fixed, proof, rollouts, own, facts, options)


RESERVED = re.compile(r"(qj|quadjax|neural_network|nn_controller|controller_quadjax)(_|$)")


def symbol_name(name: str | None, file: str) -> str:
    """The name of the files and of the table in C: the requested one, or the policy file's."""
    if name is None:
        stem = identifier(Path(file).stem)
        return (f"policy_{stem}" if RESERVED.match(stem) else stem)[:LONGEST_NAME]
    if identifier(name) != name or len(name) > LONGEST_NAME:
        raise InputError(
            f"--name {name!r}: expected a lower-case C identifier of at most {LONGEST_NAME} letters"
        )
    if RESERVED.match(name):
        raise InputError(f"--name {name!r}: files of the runtime have such names; choose another")
    return name


def _facts(policy: Policy, own: OwnRace, file: str, policy_hash: str) -> tuple[str, ...]:
    """Lines about where a policy comes from."""
    stated = {k: v for k, v in policy.source.items() if v is not None and not isinstance(v, dict)}
    source = ", ".join(f"{key}={value}" for key, value in stated.items())
    facts = (
        f"Policy   {file}, SHA-256 {policy_hash}",
        f"Source   {source or 'not stated in the policy file'}",
        f"Format   words of version {VERSION}; deterministic (mean) actions",
        f"Track    {own.track}; vehicle {own.vehicle}",
    )
    lines = [textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts]
    return tuple(itertools.chain(*lines))
