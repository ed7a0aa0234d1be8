"""The checks of a user's policy: its proof, the bits of its C, its race and its flights.

What is a property of the C runtime, whatever the policy, is checked by the repository's tests.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import emulator, flights
from quadjax.export.cases import (
    CORNERS,
    check_vectors,
    hostile_vectors,
    uniform_samples,
)
from quadjax.export.conversion import Converted
from quadjax.export.estimator_emulator import estimate_highest
from quadjax.export.flights import Rollouts
from quadjax.export.integers import ONE, quantize
from quadjax.export.names import POLICY_FILE
from quadjax.export.noise import sample
from quadjax.export.race_source import check_race
from quadjax.export.report import float64_commands
from quadjax.export.states import observe_float64
from quadjax.export.targets import Target
from quadjax.export.verify import measurements
from quadjax.export.verify.autopilot import compare_glue
from quadjax.export.verify.build import Library, Sources
from quadjax.export.verify.result import Failed, Skipped, require
from quadjax.export.words import FixedPolicy
from quadjax.race.observations import DISTURBANCES

MOTION_SAMPLES = 10_000  # of the motion that an estimator is compared in
VECTORS = 50_000  # in memory at once
MOST_STATES = 20_000
ACCURACY_SAMPLES, LARGEST_ERROR = 100_000, 1e-4  # of the range of a command
OBSERVATION_TOLERANCE = 1e-6  # of each input's range
ESTIMATOR_TOLERANCE = (1e-6, 2e-5)  # moment, N m, and force, m/s^2
BATTERY_TOLERANCE = 0.01  # rpm
LAP_TOLERANCE = 1e-3  # s


@dataclasses.dataclass
class Context:
    """One verification, of a folder or of a ``.qjp`` file alone."""

    path: Path
    fixed: FixedPolicy
    words: bytes
    target: Target
    files: dict[str, bytes] | None  # the C, by path; None: the runtime of this version
    work: Path  # a temporary folder for what is built
    count: int  # vectors
    converted: Converted | None = None  # the conversion repeated; None of a file
    runs: int = 0  # of the closed loop
    allow_unfinished: bool = False  # accept a policy that does not finish its own race
    allow_other_race: bool = False  # accept C for another race than the policy's

    @property
    def exported(self) -> Converted:
        """The conversion of the folder.

        Raises:
            Skipped: a file is checked by itself.
        """
        if self.converted is None:
            raise Skipped("needs the folder of quadjax export")
        return self.converted

    @functools.cached_property
    def sources(self) -> Sources:
        """The C that the target flies."""
        return Sources.write(self.target, self.files, self.work / "c", self.fixed)

    @functools.cached_property
    def library(self) -> Library:
        """That C on this machine."""
        return Library(self.sources, self.fixed, self.words, self.work)

    def inputs(self) -> Iterator[np.ndarray]:
        """Inputs (n, inputs) int32: corners, simulated, uniform, Gaussian, hostile, any bits."""
        network = self.fixed.network
        rows = self.fixed.cases.inputs.view(np.int32)[CORNERS:]
        simulated = rows.astype(float) / ONE * network.box.ranges
        random = np.random.default_rng(5)
        for number, start in enumerate(range(0, self.count, VECTORS)):
            count = min(VECTORS, self.count - start)
            x = check_vectors(network, count, simulated, number)
            x = np.concatenate([x, hostile_vectors(network)])
            q = quantize(x, network.box.exponents).astype(np.int32)
            any_bits = random.integers(-(2**31), 2**31, (100, network.inputs))
            yield np.concatenate([q, any_bits.astype(np.int32)])

    @functools.cached_property
    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """States (n, state_size) float32, half of them of any bits, and target gates (n,)."""
        rng, race = np.random.default_rng(6), self.fixed.race
        count = min(self.count, MOST_STATES)
        ranges = np.ldexp(1.0, np.asarray(race.exponents))
        states = (rng.uniform(-1.2, 1.2, (count, race.state_size)) * ranges).astype(np.float32)
        bits = rng.integers(0, 2**32, (count // 2, race.state_size), dtype=np.uint32)
        states[: count // 2] = bits.view(np.float32)
        return states, rng.integers(0, race.gates, count)

    @functools.cached_property
    def rollouts(self) -> Rollouts:
        """Flights of the float policy in its own race."""
        return flights.simulate(self.exported.race)

    def expected_inputs(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 by NumPy."""
        q, status = emulator.observe(self.fixed.race, states, targets)
        return np.concatenate([q, status.view(np.int32)], axis=1)


def check_proof(c: Context) -> str:
    """The proof is repeated when the folder or the file is read; this reports it."""
    network, race = c.fixed.network, c.fixed.race
    widths = "-".join(str(x) for x in (network.inputs, *(len(y.bias) for y in network.layers)))
    if c.converted is None:
        return f"{widths}, {race.gates} gates: ranges proven, self-tests repeated"
    proof, policy = c.converted.proof, c.converted.policy
    share = float(np.max(proof.error_bound / (policy.command_high - policy.command_low)))
    return (
        f"{widths}: largest sum 2^{max(proof.accumulator_bits):.3f} < 2^63 for every input; error "
        f"at most {float(np.max(proof.error_bound)):.3g} {network.unit}, {share:.2g} of a "
        "command's range"
    )


def check_host(c: Context) -> str:
    """The C on this machine and NumPy agree on ordinary and hostile inputs and states."""
    count, network = 0, c.fixed.network
    for q in c.inputs():
        _same("inputs", c.library.forward(q), emulator.forward_rows(network, q))
        if (tables := c.fixed.noise) is not None:
            _same("samples", c.library.sample(q, count), sample(network, tables, q, count))
        count += len(q)
    states, targets = c.states
    _same("states", c.library.observe(states, targets), c.expected_inputs(states, targets))
    text = f"{count} inputs and {len(states)} states of any bits: the same bits"
    if c.converted is None:
        return text
    x, policy = uniform_samples(network, ACCURACY_SAMPLES, 3), c.converted.policy
    commands = c.library.forward(quantize(x, network.box.exponents))[:, :4]
    span = policy.command_high - policy.command_low
    apart = commands / 2.0**network.fraction_bits - float64_commands(policy, x)
    error = float(np.max(np.abs(apart) / span))
    require(error <= LARGEST_ERROR, f"{error:.2g} of a command's range: above {LARGEST_ERROR:g}")
    return f"{text}; within {error:.2g} of a command's range of float64"


def _same(what: str, values: np.ndarray, expected: np.ndarray) -> None:
    wrong = np.flatnonzero(np.any(values != expected, axis=1))
    require(not wrong.size, f"{wrong.size} of {len(values)} {what} differ, first {wrong[:1]}")


def check_glue(c: Context) -> str:
    """The glue of the autopilot, in a stand-in for its firmware, gives NumPy's commands."""
    if not c.target.glue:
        raise Skipped(f"{c.target.autopilot} calls the pilot: the target has no glue")
    return compare_glue(c.sources, c.fixed, c.work)


def check_simulator(c: Context) -> str:
    """The C's observation of simulated states and its gates against the simulator's."""
    race, network, simulated = c.exported.race, c.fixed.network, c.rollouts.thinned()
    rows = c.library.observe(simulated.states, simulated.targets)
    require(not np.any(rows[:, network.inputs :]), "a simulated state was clipped")
    exact = observe_float64(race, simulated.states, simulated.targets)
    observed = rows[:, : network.inputs] / 2.0**30 * network.box.ranges
    error = np.abs(observed - exact) / network.box.ranges
    # A yaw within rounding of half a turn is the same angle on either side.
    for name in network.box.layout.names:
        if name == "attitude" or name.endswith("_yaw"):
            yaw = network.box.layout.slice(name).stop - 1
            other = np.abs(error[:, yaw] - 2.0 * np.pi / network.box.ranges[yaw])
            error[:, yaw] = np.minimum(error[:, yaw], other)
    worst = float(error.max())
    require(worst <= OBSERVATION_TOLERANCE, f"an input is {worst:.2g} of its range apart")
    positions, targets = flights.wander(race, steps=5000)
    events = c.library.events(positions, int(targets[0]))
    # The simulator's target at a step is the one after the step's own crossing.
    wrong = np.flatnonzero(events[:, 1] != targets)
    require(not wrong.size, f"another target at step {wrong[0] if wrong.size else 0}")
    _, passed, missed = np.bincount(events[:, 0], minlength=3)
    require(min(passed, missed) > 0, "no gate was passed, or none missed")
    return (
        f"{len(rows)} simulated states: within {worst:.1e} of each input's range; {passed} gates "
        f"passed and {missed} missed at the same steps"
    )


def check_estimators(c: Context) -> str:
    """The C's estimators against those of ``quadjax.vehicle`` in float64."""
    if c.fixed.estimator is None and c.fixed.battery is None:
        zero = [name for name in DISTURBANCES if name in c.fixed.network.box.layout]
        why = f"{' and '.join(zero)} are zero in its observation, as in its training"
        raise Skipped(why if zero else "the policy observes nothing that is estimated on board")
    parts = [_disturbances(c)] if c.fixed.estimator is not None else []
    parts += [_highest(c)] if c.fixed.battery is not None else []
    return "; ".join(parts)


def _disturbances(c: Context) -> str:
    """Of a drone that tumbles, clipped to the ranges."""
    tables, race, rng = c.fixed.estimator, c.exported.race, np.random.default_rng(0)
    assert tables is not None
    options = c.exported.options
    rate, cutoff, vehicle = options.sample_rate, options.cutoff, race.params.vehicle
    log = measurements.tumbling(rng, rate, MOTION_SAMPLES / rate)
    limits = np.ldexp(np.float32(1.0), np.array(tables.exponents))
    log = np.clip(log, -limits, limits).astype(np.float32)
    exact = measurements.estimate_float64(vehicle, log, rate, cutoff)
    error = np.abs(c.library.estimate(log).astype(np.float64) - exact)
    moment, force = float(error[:, :3].max()), float(error[:, 3:].max())
    require(moment <= ESTIMATOR_TOLERANCE[0], f"moment off by {moment:.2g} N m")
    require(force <= ESTIMATOR_TOLERANCE[1], f"force off by {force:.2g} m/s^2")
    return f"{len(log)} samples: within {moment:.1e} N m and {force:.1e} m/s^2 of float64"


def _highest(c: Context) -> str:
    """At full power and less in turn as the battery empties."""
    tables, race, rng = c.fixed.battery, c.exported.race, np.random.default_rng(0)
    assert tables is not None
    rate, constants = c.exported.options.sample_rate, race.params.vehicle.constants
    log = measurements.full_power_bursts(rng, constants, rate, MOTION_SAMPLES / rate)
    highest, first = c.library.highest_rpm(log), tables.first * tables.unit
    require(np.array_equal(highest, estimate_highest(tables, log)), "C and NumPy differ")
    exact = measurements.highest_float64(constants, first, log, rate)
    worst = float(np.abs(highest - exact).max())
    require(worst <= BATTERY_TOLERANCE, f"the highest rpm is off by {worst:.2g} rpm")
    return f"{len(log)} samples: the highest rpm within {worst:.1e} rpm of float64"


def check_race_of_policy(c: Context) -> str:
    """The race in the C is the one in the policy file."""
    converted, path = c.exported, c.path / POLICY_FILE
    allowed = c.allow_other_race and converted.options.allow_other_race
    check = functools.partial(check_race, converted.policy, converted.race, path)
    return _unless(allowed, check, "--allow-other-race")


def check_flights(c: Context) -> str:
    """The policy finishes its own race; with ``runs``, fixed point flies as float does."""
    converted = c.exported
    laps = c.rollouts.laps
    allowed = c.allow_unfinished and converted.options.allow_unfinished
    check = functools.partial(flights.check_finished, laps, converted.race, c.fixed.name)
    text = _unless(allowed, check, "--allow-unfinished")
    if not c.runs:
        return text
    ranges = c.fixed.network.box.declared
    single, fixed = flights.fly_float_and_fixed(converted.race, converted.policy, ranges, c.runs)
    require(single.crashes == fixed.crashes, "fixed point has other finishes than float")
    both = np.isfinite(single.totals)
    apart = float(np.max(np.abs(single.totals[both] - fixed.totals[both]), initial=0.0))
    require(apart <= LAP_TOLERANCE, f"times {apart * 1000:.1f} ms apart")
    flown = f"{c.runs} flights of float and fixed point: at most {apart * 1000:.1f} ms apart"
    return f"{text}; {flown}"


def _unless(allowed: bool, check: Callable[[], str], option: str) -> str:
    """The result of a check; a failed one that an option allows is skipped."""
    try:
        return check()
    except InputError as error:
        if allowed:
            raise Skipped(f"{error}; allowed by {option}") from None
        raise Failed(str(error)) from None


CHECKS: dict[str, Callable[[Context], str]] = {
    "range proof": check_proof,
    "NumPy = C": check_host,
    "glue": check_glue,
    "simulator": check_simulator,
    "estimators": check_estimators,
    "own race": check_race_of_policy,
    "own flights": check_flights,
}
OF_A_FILE = ("range proof", "NumPy = C")
