"""The checks of a user's policy: its proof, the bits of its C, its race and its flights.

What is a property of the C runtime, whatever the policy, is checked by the repository's tests.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import battery_emulator, emulator, flights, race_emulator
from quadjax.export.battery_tables import update_error
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.convert import POLICY_FILE
from quadjax.export.integers import quantize
from quadjax.export.race_source import check_race
from quadjax.export.report import float64_commands, uniform_samples
from quadjax.export.targets import Target
from quadjax.export.verify import measurements
from quadjax.export.verify.build import BUILDS, Library, OnBoard, Sources, vehicles
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.result import Failed, Skipped, require
from quadjax.export.words import FixedPolicy
from quadjax.race.laps import Trace

TRACED_RUNS, TRACED_LAPS = 4, 3
MOST_STATES, COUNTED = 20_000, 12
ACCURACY_SAMPLES, LARGEST_ERROR = 100_000, 1e-4  # of the range of a command
OBSERVATION_TOLERANCE = 1e-6  # of each input's range
ESTIMATOR_TOLERANCE = (1e-6, 2e-5)  # moment, N m, and force, m/s^2
BATTERY_TOLERANCE = 0.01  # rpm
LAP_TOLERANCE = 1e-3  # s
LARGEST_STACK, WIDE = 3072, 120  # bytes, for networks of at most WIDE neurons per layer
CLAMPED = 4  # instructions that depend on whether a command is clamped


@dataclasses.dataclass
class Context:
    """One verification, of a folder or of a ``.qjp`` file alone."""

    fixed: FixedPolicy
    words: bytes
    target: Target
    files: dict[str, bytes] | None  # the C, by path; None: the runtime of this version
    work: Path  # a temporary folder for what is built
    count: int  # vectors
    folder: Folder | None = None
    runs: int = 0  # of the closed loop
    allow_unfinished: bool = False  # accept a policy that does not finish its own race
    allow_other_race: bool = False  # accept C for another race than the policy's

    @property
    def exported(self) -> Folder:
        """The folder.

        Raises:
            Skipped: a file is checked by itself.
        """
        if self.folder is None:
            raise Skipped("needs the folder of quadjax export")
        return self.folder

    @functools.cached_property
    def sources(self) -> Sources:
        """The C that the target flies."""
        return Sources.write(self.target, self.files, self.work / "c", self.fixed)

    @functools.cached_property
    def library(self) -> Library:
        """That C on this machine."""
        return Library(self.sources, self.fixed, self.words, self.work)

    @functools.cached_property
    def inputs(self) -> np.ndarray:
        """Inputs (n, inputs) int32: corners, simulated, uniform, Gaussian, hostile, any bits."""
        network = self.fixed.network
        seen = self.folder.rollouts.observations if self.folder else None
        x = np.concatenate([check_vectors(network, self.count, seen), hostile_vectors(network)])
        q = quantize(x, network.box.exponents).astype(np.int32)
        any_bits = np.random.default_rng(5).integers(-(2**31), 2**31, (100, network.inputs))
        return np.concatenate([q, any_bits.astype(np.int32)])

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
    def trace(self) -> Trace:
        """A few flights of the float policy, step by step."""
        return flights.fly_traced(self.exported.own, TRACED_RUNS, TRACED_LAPS)

    def expected_forward(self, q: np.ndarray) -> np.ndarray:
        """Rows (n, 5) int32, commands and trace, by NumPy."""
        commands, trace = emulator.forward_traced(self.fixed.network, q)
        return np.column_stack([commands, emulator.trace_digest(trace).view(np.int32)])

    def expected_inputs(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 by NumPy."""
        seen = race_emulator.observe(self.fixed.race, states, targets)
        status = np.stack([seen.clipped, seen.nan, seen.outside], axis=1)
        return np.concatenate([seen.q, status.astype(np.uint32).view(np.int32)], axis=1)


def check_proof(c: Context) -> str:
    """The proof is repeated when the folder or the file is read; this reports it."""
    widths = "-".join(
        str(x) for x in (c.fixed.network.inputs, *(len(y.bias) for y in c.fixed.network.layers))
    )
    if c.folder is None:
        return f"{widths}, {c.fixed.race.gates} gates: ranges proven, self-tests repeated"
    proof, policy = c.folder.proof, c.folder.policy
    part = float(np.max(proof.error_bound / (policy.command_high - policy.command_low)))
    return (
        f"{widths}: largest sum 2^{max(proof.accumulator_bits):.3f} < 2^63 for every input; error "
        f"at most {float(np.max(proof.error_bound)):.3g} {c.fixed.network.unit}, {part:.2g} of a "
        "command's range"
    )


def check_host(c: Context) -> str:
    """The C on this machine and NumPy agree on ordinary and hostile inputs and states."""
    _same("inputs", c.library.forward(c.inputs), c.expected_forward(c.inputs))
    states, targets = c.states
    _same("states", c.library.observe(states, targets), c.expected_inputs(states, targets))
    text = f"{len(c.inputs)} inputs and {len(states)} states of any bits: the same bits"
    if c.folder is None:
        return text
    x = uniform_samples(c.fixed.network, ACCURACY_SAMPLES, 3)
    policy, network = c.folder.policy, c.fixed.network
    q = quantize(x, network.box.exponents)
    found = c.library.forward(q)[:, :4] / 2.0**network.fraction_bits
    span = policy.command_high - policy.command_low
    error = float(np.max(np.abs(found - float64_commands(policy, x)) / span))
    require(error <= LARGEST_ERROR, f"{error:.2g} of a command's range: above {LARGEST_ERROR:g}")
    return f"{text}; within {error:.2g} of a command's range of float64"


def _same(what: str, found: np.ndarray, expected: np.ndarray) -> None:
    wrong = np.flatnonzero(np.any(found != expected, axis=1))
    require(not wrong.size, f"{wrong.size} of {len(found)} {what} differ, first {wrong[:1]}")


def check_processor(c: Context) -> str:
    """The C on the emulated processor: the bits of NumPy, instructions, stack and memory."""
    parts = []
    for build in BUILDS[c.target.processor]:
        with contextlib.suppress(Skipped):
            board = OnBoard(c.sources, build, c.words, c.work)
            parts.append(f"{build.label}: {_on_board(c, board)}")
    if not parts:
        raise Skipped("no compiler or emulator for ARM; pip install 'quadjax[verify]'")
    return f"the same bits; {'; '.join(parts)}; words {len(c.words):,} B"


def _on_board(c: Context, board: OnBoard) -> str:
    q, (states, targets) = c.inputs[:: max(1, len(c.inputs) // 500)], c.states
    _same("inputs", board.rows("forward", 5, len(q), q), c.expected_forward(q))
    states, targets = states[-500:], targets[-500:]
    found = board.rows("observe", q.shape[1] + 3, len(states), states, targets.astype(np.uint32))
    _same("states", found, c.expected_inputs(states, targets))
    simulated = states if c.folder is None else c.folder.rollouts.states
    rows = np.linspace(0, len(simulated) - 1, COUNTED).astype(int)
    chosen = np.concatenate([simulated[rows], c.states[0][:COUNTED]]).astype(np.float32)
    steps = [board.count("step", row) for row in vehicles(c.fixed, chosen)[:, None]]
    x = hostile_vectors(c.fixed.network)
    x = x[np.linspace(0, len(x) - 1, COUNTED).astype(int)]
    single = [board.count("infer", row) for row in x]
    counts = [count for count, _ in single]
    allowed = max(max(counts) // 1000, CLAMPED * c.fixed.network.outputs)
    require(max(counts) - min(counts) <= allowed, f"instructions depend on the data: {counts}")
    stack = max(own for _, own in (*steps, *single))
    widest = max(len(layer.bias) for layer in c.fixed.network.layers)
    require(stack < LARGEST_STACK or widest > WIDE, f"{stack} bytes of stack")
    loading, more = board.loading()
    return (
        f"an inference {max(counts):,} instructions, a step {max(count for count, _ in steps):,}, "
        f"{stack} B stack; loading {loading:,}, {more} B; code {board.read_only:,} B flash, "
        f"{board.writable} B writable"
    )


def check_simulator(c: Context) -> str:
    """The C's observation of simulated states and its gates against the simulator's."""
    folder, network, seen = c.exported, c.fixed.network, c.exported.rollouts
    rows = c.library.observe(seen.states, seen.targets)
    require(not np.any(rows[:, network.inputs :]), "a simulated state was clipped")
    shown = flights.observe_float64(folder.own, seen.states, seen.targets)
    found = rows[:, : network.inputs] / 2.0**30 * network.box.ranges
    error = np.abs(found - shown) / network.box.ranges
    # A yaw within rounding of half a turn is the same angle on either side.
    if "attitude" in network.box.layout:
        turn = network.box.layout.slice("attitude").start + 2
        other = np.abs(error[:, turn] - 2.0 * np.pi / network.box.ranges[turn])
        error[:, turn] = np.minimum(error[:, turn], other)
    worst = float(error.max())
    require(worst <= OBSERVATION_TOLERANCE, f"an input is {worst:.2g} of its range apart")
    passed, missed = _check_gates(c)
    return (
        f"{len(rows)} simulated states: within {worst:.1e} of each input's range; {passed} gates "
        f"passed and {missed} missed at the same steps"
    )


def _check_gates(c: Context) -> tuple[int, int]:
    """The C passes and misses the same gates as the simulator, at the same steps."""
    followed = [*flights.paths(c.trace), flights.wander(c.exported.own, steps=5000)]
    counts = np.zeros(3, int)
    for positions, targets in followed:
        rows = c.library.events(positions, int(targets[0]))
        # The simulator's target at a step is the one after the step's own crossing.
        wrong = np.flatnonzero(rows[:, 1] != targets)
        require(not wrong.size, f"another target at step {wrong[0] if wrong.size else 0}")
        counts += np.bincount(rows[:, 0], minlength=3)
    passed, missed = counts[race_emulator.PASSED], counts[race_emulator.MISSED]
    require(min(passed, missed) > 0, "no gate was passed, or none missed")
    return int(passed), int(missed)


def check_estimators(c: Context) -> str:
    """The C's estimators against those of ``quadjax.vehicle`` in float64."""
    if c.fixed.estimator is None and c.fixed.battery is None:
        raise Skipped("the policy observes nothing that is estimated on board")
    parts = [_disturbances(c)] if c.fixed.estimator is not None else []
    parts += [_highest(c)] if c.fixed.battery is not None else []
    return "; ".join(parts)


def _disturbances(c: Context) -> str:
    """Simulated flights and a drone that tumbles, both clipped to the ranges."""
    tables, own, rng = c.fixed.estimator, c.exported.own, np.random.default_rng(0)
    assert tables is not None
    options = c.exported.options
    rate, cutoff, vehicle = options.sample_rate, options.cutoff, own.params.vehicle
    logs = measurements.simulated(rng, vehicle, c.trace, own.time_step, rate)
    logs = np.concatenate([logs, measurements.tumbling(rng, rate, logs.shape[1] / rate)[None]])
    limits = np.ldexp(np.float32(1.0), np.array(tables.exponents))
    logs = np.clip(logs, -limits, limits).astype(np.float32)
    found = np.stack([c.library.estimate(log) for log in logs]).astype(np.float64)
    error = np.abs(found - measurements.estimate_float64(vehicle, logs, rate, cutoff))
    moment, force = float(error[..., :3].max()), float(error[..., 3:].max())
    require(moment <= ESTIMATOR_TOLERANCE[0], f"moment off by {moment:.2g} N m")
    require(force <= ESTIMATOR_TOLERANCE[1], f"force off by {force:.2g} m/s^2")
    count = len(logs) * logs.shape[1]
    return f"{count} samples: within {moment:.1e} N m and {force:.1e} m/s^2 of float64"


def _highest(c: Context) -> str:
    """Simulated flights, and full power and less in turn as the battery empties."""
    tables, own, rng = c.fixed.battery, c.exported.own, np.random.default_rng(0)
    assert tables is not None
    rate, constants = tables.sample_rate, own.params.vehicle.constants
    logs = measurements.speeds_and_commands(rng, c.trace, own.time_step, rate)
    bursts = measurements.full_power_bursts(rng, constants, rate, logs.shape[1] / rate)
    logs = np.concatenate([logs, bursts[None]])
    found = np.stack([c.library.highest_rpm(log) for log in logs])
    require(np.array_equal(found, battery_emulator.run(tables, logs)), "C and NumPy differ")
    exact = measurements.highest_float64(constants, tables.first * tables.unit, logs, rate)
    worst = float(np.abs(found - exact).max())
    require(worst <= BATTERY_TOLERANCE, f"the highest rpm is off by {worst:.2g} rpm")
    return (
        f"{logs.shape[0] * logs.shape[1]} samples: the highest rpm within {worst:.1e} rpm of "
        f"float64; proven for one sample: {update_error(tables):.1e} rpm"
    )


def check_race_of_policy(c: Context) -> str:
    """The race in the C is the one in the policy file."""
    folder = c.exported
    allowed = c.allow_other_race and folder.options.allow_other_race
    path = folder.path / POLICY_FILE
    check = functools.partial(check_race, folder.policy, folder.own, path)
    return _unless(allowed, check, "allow_other_race=True")


def check_flights(c: Context) -> str:
    """The policy finishes its own race; with ``runs``, fixed point flies as float does."""
    folder = c.exported
    laps = flights.simulate(folder.own).laps
    allowed = c.allow_unfinished and folder.options.allow_unfinished
    check = functools.partial(flights.check_finished, laps, folder.own, c.fixed.name)
    text = _unless(allowed, check, "allow_unfinished=True")
    return f"{text}; {_closed_loop(c)}" if c.runs else text


def _unless(allowed: bool, check: Callable[[], str], option: str) -> str:
    """The result of a check; a failed one that an option allows is skipped."""
    try:
        return check()
    except InputError as error:
        if allowed:
            raise Skipped(f"{error}; allowed by {option}") from None
        raise Failed(str(error)) from None


def _closed_loop(c: Context) -> str:
    """The fixed-point policy finishes where the float policy does, in the same times."""
    folder, ranges = c.exported, c.fixed.network.box.declared
    single, fixed = flights.fly_float_and_fixed(folder.own, folder.policy, ranges, c.runs)
    require(single.crashes == fixed.crashes, "fixed point has other finishes than float")
    both = np.isfinite(single.totals)
    apart = float(np.max(np.abs(single.totals[both] - fixed.totals[both]), initial=0.0))
    require(apart <= LAP_TOLERANCE, f"times {apart * 1000:.1f} ms apart")
    return f"{c.runs} flights of float and fixed point: at most {apart * 1000:.1f} ms apart"


CHECKS: dict[str, Callable[[Context], str]] = {
    "range proof": check_proof,
    "NumPy = C": check_host,
    "processor": check_processor,
    "simulator": check_simulator,
    "estimators": check_estimators,
    "own race": check_race_of_policy,
    "own flights": check_flights,
}
OF_A_FILE = ("range proof", "NumPy = C", "processor")
