"""From a policy and its race to integers, their proof, the files of an export and its report."""

import dataclasses
import functools
import hashlib
import textwrap
from pathlib import Path

from quadjax.export import flights
from quadjax.export.battery import make_battery
from quadjax.export.cases import Cases, Tables, make_cases
from quadjax.export.disturbances import CUTOFF, SAMPLE_RATE, make_estimator
from quadjax.export.flights import Rollouts
from quadjax.export.inner_loop import FILE as INNER_LOOP
from quadjax.export.inner_loop import inner_loop
from quadjax.export.network import convert
from quadjax.export.noise import make_noise
from quadjax.export.proof import Proof, prove
from quadjax.export.race_source import PolicyRace
from quadjax.export.race_tables import make_tables
from quadjax.export.ranges import track_ranges
from quadjax.export.render import call_frequency, glue_header, policy_header, sizes_header
from quadjax.export.suitability import check_target, observed_fields, target_of
from quadjax.export.targets import DEFAULT_TARGET, Target, runtime_files
from quadjax.export.words import FixedPolicy, pack
from quadjax.policy.file import Policy
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.vehicle.battery import middle_limit

COMMENT_WIDTH = 94


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of an export; see ``convert.export_c``. The report keeps them."""

    name: str  # of the files and of the table in C
    ranges: dict[str, float] = dataclasses.field(default_factory=dict)
    sample_rate: float = SAMPLE_RATE
    cutoff: float = CUTOFF
    allow_unfinished: bool = False
    allow_other_race: bool = False
    target: str = DEFAULT_TARGET
    sampled: bool = False  # the actions are samples, not the mean


@dataclasses.dataclass(frozen=True)
class Converted:
    """A policy and its race as integers: everything that the files are made from."""

    policy: Policy
    file: str  # name of the policy file
    fixed: FixedPolicy
    proof: Proof
    rollouts: Rollouts | None  # of the policy's own race; None where its cases were given
    race: PolicyRace
    options: Options

    @property
    def target(self) -> Target:
        """Processor and autopilot."""
        return target_of(self.options.target, self.policy.vehicle)

    @functools.cached_property
    def words(self) -> bytes:
        """The policy as words."""
        return pack(self.fixed)

    def files(self) -> dict[str, bytes]:
        """Every emitted file of the policy and its C, by its path in the folder."""
        target, texts = self.target, {}
        texts["qj_sizes.h"] = sizes_header(self.fixed, any_policy=target.as_file)
        if not target.as_file:
            texts[f"{self.options.name}.h"] = policy_header(self.fixed, self.words, self._facts())
        if target.glue:
            texts["quadjax_policy.h"] = glue_header(self.fixed, self.race)
        placed = {f"{target.folder}/{name}": text for name, text in texts.items()}
        every = runtime_files(target) | placed
        if target.glue == "paparazzi":  # the autopilot calls the module at the estimators' rate
            module, rate = f"{target.folder}/quadjax.xml", call_frequency(self.fixed)
            every[module] = every[module].replace('freq="512"', f'freq="{rate}"')
        words = {f"{self.options.name}.qjp": self.words}
        if (text := inner_loop(self.fixed, self.race, target)) is not None:
            every[INNER_LOOP] = text
        return {name: text.encode() for name, text in every.items()} | words

    def _facts(self) -> list[str]:
        """Lines about where the policy comes from."""
        stated = self.policy.source.items()
        source = ", ".join(
            f"{key}={value}" for key, value in stated if not isinstance(value, dict | None)
        )
        facts = (
            f"Policy   {self.file}, SHA-256 {self.fixed.policy_hash}",
            f"Source   {source or 'not stated in the policy file'}",
            f"Format   words of version {self.fixed.version}; {self.fixed.actions} actions",
            f"Track    {self.race.track}; vehicle {self.race.vehicle}",
        )
        lines = (textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts)
        return sum(lines, [])


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def convert_policy(
    policy: Policy,
    race: PolicyRace,
    options: Options,
    file: str,
    path: Path,
    rollouts: Rollouts | None = None,
    cases: Cases | None = None,
) -> Converted:
    """Convert and prove a policy, and simulate its own race.

    Args:
        policy: the policy.
        race: its race.
        options: of the export.
        file: name of the policy file, for the headers.
        path: of the policy file.
        rollouts: of its own race, if they have been simulated.
        cases: self-tests of an earlier conversion, which is repeated without simulating.

    Raises:
        InputError: see ``convert.export_c``.
    """
    network = convert(policy, track_ranges(policy.layout, race.params.track) | options.ranges)
    proof = prove(network, policy)
    race_tables = make_tables(network.box, policy, race.environment, race.params)
    vehicle, observed = race.params.vehicle, observed_fields(race_tables)
    target = target_of(options.target, policy.vehicle)
    if target.glue == "paparazzi" and observed & {*DISTURBANCES, HIGHEST_RPM}:
        target = dataclasses.replace(target, calls=options.sample_rate)
    check_target(target, network, race_tables)
    if rollouts is None and cases is None:
        rollouts = flights.simulate(race)
        if not options.allow_unfinished:
            flights.check_finished(rollouts.laps, race, file)
        network.box.check(rollouts.observations)
        rollouts = rollouts.thinned()
    estimator = battery = None
    if observed & set(DISTURBANCES) and network.model.name == "motor":
        numbers = (options.sample_rate, options.cutoff)
        estimator = make_estimator(vehicle.constants, vehicle.residual, *numbers)
    if HIGHEST_RPM in observed:
        assert race.params.battery is not None
        first = float(middle_limit(race.params.battery))
        battery = make_battery(vehicle.constants, first, options.sample_rate)
    tables = Tables(network, race_tables, estimator, battery)
    if cases is None:
        assert rollouts is not None
        cases = make_cases(tables, rollouts.observations, rollouts.states, rollouts.targets)
    noise = make_noise(policy, network) if options.sampled else None
    names = (options.name, sha256(path))
    fixed = FixedPolicy(network, race_tables, estimator, battery, *names, cases, noise)
    return Converted(policy, file, fixed, proof, rollouts, race, options)
