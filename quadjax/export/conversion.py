"""From a policy and its race to numbers, their proof, and the files of an export."""

import dataclasses
import functools
import hashlib
import textwrap
from pathlib import Path

import numpy as np

from quadjax.export.estimators import (
    CUTOFF,
    SAMPLE_RATE,
    make_battery_model,
    make_disturbance_model,
)
from quadjax.export.header import glue_header, policy_header, sizes_header
from quadjax.export.network import convert
from quadjax.export.observation import make_observation
from quadjax.export.policy_in_c import PolicyInC
from quadjax.export.proof import Proof, prove
from quadjax.export.race_source import PolicyRace
from quadjax.export.ranges import track_ranges
from quadjax.export.suitability import check_target, kind_of, target_of
from quadjax.export.targets import DEFAULT_TARGET, RATES, Target, runtime_files
from quadjax.policy.file import Policy
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.vehicle.battery import middle_limit

COMMENT_WIDTH = 94


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of an export; see ``convert.export_c``. The report keeps them."""

    name: str  # of the header and of the policy in it
    ranges: dict[str, float] = dataclasses.field(default_factory=dict)
    sample_rate: float = SAMPLE_RATE
    cutoff: float = CUTOFF
    allow_unfinished: bool = False
    allow_other_race: bool = False
    target: str = DEFAULT_TARGET
    sampled: bool = False  # the actions are samples, not the mean


@dataclasses.dataclass(frozen=True)
class Converted:
    """A policy and its race as numbers: everything that the files are made from."""

    policy: Policy
    file: str  # name of the policy file
    policy_hash: str  # SHA-256 of the policy file
    in_c: PolicyInC
    proof: Proof
    race: PolicyRace
    options: Options

    @property
    def target(self) -> Target:
        """Processor and autopilot."""
        return target_of(self.options.target, self.policy.vehicle)

    @property
    def frequency(self) -> float:
        """Calls of the pilot, Hz: at the rate of the estimators, or of the autopilot."""
        return self.in_c.sample_rate or self.target.calls or 1.0 / self.in_c.observation.time_step

    @functools.cached_property
    def files(self) -> dict[str, bytes]:
        """Every file of the C, by its path in the folder of the export."""
        target, every = self.target, runtime_files(self.target)
        texts = {
            f"{self.in_c.name}.h": policy_header(self.in_c, self._facts()),
            "qj_sizes.h": sizes_header(self.in_c),
        }
        if target.glue:
            texts["quadjax_policy.h"] = glue_header(self.in_c, self.race, self.frequency)
        if target.glue == "paparazzi":  # which calls the module at this rate
            module, rate = f"{target.folder}/quadjax.xml", f'freq="{self.frequency:g}"'
            every[module] = every[module].replace('freq="512"', rate)
        every |= {f"{target.folder}/{name}": text for name, text in texts.items()}
        return {name: text.encode() for name, text in every.items()}

    def _facts(self) -> list[str]:
        """Lines about where the policy comes from, and what it needs."""
        stated, race = self.policy.source.items(), self.race
        source = ", ".join(
            f"{key}={value}" for key, value in stated if not isinstance(value, dict | None)
        )
        facts = [
            f"Policy   {self.file}, SHA-256 {self.policy_hash}",
            f"Source   {source or 'not stated in the policy file'}",
            f"Track    {race.track}; vehicle {race.vehicle}; {self.in_c.actions} actions",
        ]
        if kind_of(self.policy.vehicle) == RATES:
            c = race.params.vehicle.constants
            lags = f"rates {float(c.tau_rate):g} s, thrust {float(c.tau_thrust):g} s"
            facts.append(f"Inner    loop that the training assumes, first-order lags: {lags}")
        lines = (textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts)
        return sum(lines, [])


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def convert_policy(
    policy: Policy, race: PolicyRace, options: Options, file: str, path: Path
) -> Converted:
    """Convert and prove a policy.

    Args:
        policy: the policy.
        race: its race.
        options: of the export.
        file: name of the policy file, for the headers.
        path: of the policy file.

    Raises:
        InputError: see ``convert.export_c``.
    """
    network = convert(policy, track_ranges(policy.layout, race.params.track) | options.ranges)
    proof = prove(network, policy)
    observation = make_observation(network.box, policy, race.environment, race.params)
    vehicle, observed = race.params.vehicle, observation.observed
    target = target_of(options.target, policy.vehicle)
    if target.glue == "paparazzi" and observed & {*DISTURBANCES, HIGHEST_RPM}:
        target = dataclasses.replace(target, calls=options.sample_rate)
    check_target(target, policy, observed, len(observation.gates), race.time_step)
    disturbance = battery = noise = None
    if observed & set(DISTURBANCES) and policy.vehicle == "motor":
        numbers = (options.sample_rate, options.cutoff)
        disturbance = make_disturbance_model(vehicle.constants, vehicle.residual, *numbers)
    if HIGHEST_RPM in observed:
        assert race.params.battery is not None
        first = float(middle_limit(race.params.battery))
        battery = make_battery_model(vehicle.constants, first, options.sample_rate)
    if options.sampled:
        half = 0.5 * (policy.command_high - policy.command_low)
        noise = (np.exp(policy.log_std.astype(np.float64)) * half).astype(np.float32)
    on_clamped = policy.noise_on == "clipped_mean"
    parts = (network, observation, disturbance, battery, noise, on_clamped)
    in_c = PolicyInC(options.name, *parts)
    return Converted(policy, file, sha256(path), in_c, proof, race, options)
