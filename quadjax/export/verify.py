"""The checks of an exported folder: its proof, the bits of its C, its race and its flights.

What is a property of the C runtime, whatever the policy, is checked by the repository's tests.
"""

import dataclasses
import functools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError
from quadjax.export import emulator, flights, motions
from quadjax.export.compiler import Failed, Skipped
from quadjax.export.conversion import Converted
from quadjax.export.flights import Rollouts
from quadjax.export.folder import read_folder
from quadjax.export.integers import quantize
from quadjax.export.library import Library
from quadjax.export.names import POLICY_FILE
from quadjax.export.race_source import check_race
from quadjax.export.report import float64_commands, uniform_samples
from quadjax.export.states import as_in_c, observe_float64
from quadjax.export.vectors import check_vectors, hostile_vectors

PASSED, FAILED, SKIPPED = "pass", "FAIL", "skipped"
VECTORS = 50_000  # in memory at once
ACCURACY_SAMPLES, LARGEST_ERROR = 100_000, 1e-4  # of the range of a command
OBSERVATION_TOLERANCE = 1e-4  # of each input's range
MOTION_SAMPLES = 10_000  # that the estimators are compared in
ESTIMATOR_TOLERANCE = (1e-4, 1e-3)  # moment, N m, and force, m/s^2
BATTERY_TOLERANCE = 0.1  # rpm


@dataclasses.dataclass(frozen=True)
class Result:
    """One row of the table."""

    check: str
    verdict: str  # PASSED | FAILED | SKIPPED
    figure: str  # measured value, or why the check was skipped
    seconds: float = 0.0

    def text(self, width: int) -> str:
        """The row in a line; ``width`` is that of the checks' names."""
        return f"{self.check:<{width}}  {self.verdict:<8}  {self.figure}"


@dataclasses.dataclass
class Context:
    """One verification of a folder."""

    path: Path
    converted: Converted  # the conversion repeated
    work: Path  # a temporary folder for what is built
    count: int  # vectors
    allow_unfinished: bool
    allow_other_race: bool

    @functools.cached_property
    def library(self) -> Library:
        """The C on this machine."""
        return Library(self.converted, self.work)

    @functools.cached_property
    def rollouts(self) -> Rollouts:
        """Flights of the float policy in its own race."""
        return flights.simulate(self.converted.race)


def verify(
    path: Path | str,
    vectors: int = 5_000,
    *,
    allow_unfinished: bool = False,
    allow_other_race: bool = False,
    config: Config | Path | str | None = None,
    report: Callable[[Result], None] = lambda _: None,
    announce: Callable[[str], None] = lambda _: None,
) -> list[Result]:
    """Verify an exported folder with a C compiler of this machine.

    Args:
        path: a folder that ``export_c`` wrote.
        vectors: number of inputs on which C and NumPy must agree.
        allow_unfinished: accept a policy that was exported although it does not finish its race.
        allow_other_race: accept an export for another race than the one in the policy file.
        config: of the race, where that of the folder names code.
        report: called with every result.
        announce: called with the name of every check before it runs.

    Returns:
        A result for each check, in order.

    Raises:
        InputError: no such folder, or one that is damaged or not what the converter writes; nothing
            is compiled.
    """
    enable_compilation_cache()
    converted = read_folder(Path(path), config)
    allowed = (allow_unfinished, allow_other_race)
    results = []
    with tempfile.TemporaryDirectory() as work:
        context = Context(Path(path), converted, Path(work), vectors, *allowed)
        for name, check in CHECKS.items():
            announce(name)
            results.append(_run(name, functools.partial(check, context)))
            report(results[-1])
    return results


def _run(name: str, check: Callable[[], str]) -> Result:
    """Run one check, which returns its figure or raises ``Skipped`` or ``Failed``."""
    start = time.monotonic()
    try:
        verdict, figure = PASSED, check()
    except Skipped as reason:
        verdict, figure = SKIPPED, str(reason)
    except Failed as reason:
        verdict, figure = FAILED, str(reason)
    except Exception as error:  # any other error is a failure
        verdict, figure = FAILED, f"{type(error).__name__}: {error}"
    return Result(name, verdict, " ".join(figure.split()), time.monotonic() - start)


def require(condition: bool, message: str) -> None:
    """Raise ``Failed`` with the message unless the condition holds."""
    if not condition:
        raise Failed(message)


# ---- checks --------------------------------------------------------------------------------------


def check_files(c: Context) -> str:
    """The conversion and its proof were repeated when the folder was read; this reports them."""
    converted, network = c.converted, c.converted.in_c.network
    proof, files = converted.proof, len(converted.files)
    return (
        f"{files} files; no sum reaches 2^63; error at most "
        f"{float(np.max(proof.error_bound)):.2g} {network.unit}".rstrip()
    )


def check_network(c: Context) -> str:
    """The network in C and in NumPy have the same bits, and are close to float64."""
    count, network, policy = 0, c.converted.in_c.network, c.converted.policy
    for x in _observations(c):
        q = quantize(x, network.box.exponents)
        _same("quantized inputs", c.library.quantize(x), q)
        _same("outputs", c.library.forward(q), emulator.forward_rows(network, q))
        count += len(x)
    any_bits = np.random.default_rng(5).integers(-(2**31), 2**31, (1000, network.inputs))
    _same("outputs", c.library.forward(any_bits), emulator.forward_rows(network, any_bits))
    x = uniform_samples(network, ACCURACY_SAMPLES, 3)
    commands = c.library.forward(c.library.quantize(x))[:, :-1] / 2.0**network.fraction_bits
    apart = commands - float64_commands(policy, x)
    error = float(np.max(np.abs(apart) / (policy.command_high - policy.command_low)))
    require(error <= LARGEST_ERROR, f"{error:.2g} of a command's range: above {LARGEST_ERROR:g}")
    return f"{count} inputs: the bits of NumPy; {error:.0e} of a range from float64"


def _observations(c: Context) -> Iterator[np.ndarray]:
    """Observations (n, inputs): corners, of flights, uniform, Gaussian, hostile."""
    network, flown = c.converted.in_c.network, c.rollouts.thinned().observations
    for number, start in enumerate(range(0, c.count, VECTORS)):
        x = check_vectors(network, min(VECTORS, c.count - start), flown, number)
        yield np.concatenate([x, hostile_vectors(network)])


def _same(what: str, values: np.ndarray, expected: np.ndarray) -> None:
    wrong = np.flatnonzero(np.any(values != expected, axis=1))
    require(not wrong.size, f"{wrong.size} of {len(values)} {what} differ, first {wrong[:1]}")


def check_observation(c: Context) -> str:
    """The observation in C of states of flights against the simulator's in float64."""
    race, box, flown = c.converted.race, c.converted.in_c.network.box, c.rollouts.thinned()
    layout = race.environment.layout
    states = as_in_c(layout, race.environment.model, flown.states)
    exact = observe_float64(race, flown.states, flown.targets)
    error = np.abs(c.library.observe(states, flown.targets) - exact) / box.ranges
    for name in layout.names:  # a yaw within rounding of half a turn is the same on either side
        if name == "attitude" or name.endswith("_yaw"):
            yaw = layout.slice(name).stop - 1
            other = np.abs(error[:, yaw] - 2.0 * np.pi / box.ranges[yaw])
            error[:, yaw] = np.minimum(error[:, yaw], other)
    worst = float(error.max())
    require(worst <= OBSERVATION_TOLERANCE, f"an input is {worst:.2g} of its range apart")
    return f"{len(states)} states: {worst:.0e} of a range from the simulator"


def check_gates(c: Context) -> str:
    """The C passes the gates of flights at the steps at which the race's own rule does."""
    passed = 0
    for number, (positions, targets) in enumerate(c.rollouts.paths):
        events = c.library.race(positions, int(targets[0]))
        wrong = np.flatnonzero(events[:, 1] != targets)
        require(not wrong.size, f"flight {number}: another target at step {wrong[:1]}")
        passed += int(np.sum(events[:, 0] == 1))
    if not passed:
        raise Skipped("no flight passes a gate")
    test = c.converted.in_c.observation.gate_test
    flown = f"{len(c.rollouts.paths)} flights by the rule {test}"
    return f"{flown}: {passed} gates at the simulator's steps"


def check_estimators(c: Context) -> str:
    """The C's estimators against those of ``quadjax.vehicle`` in float64."""
    in_c, parts = c.converted.in_c, []
    if in_c.disturbance is not None:
        parts.append(_disturbances(c))
    if in_c.battery is not None:
        parts.append(_highest(c))
    if not parts:
        raise Skipped("nothing that the policy observes is estimated on board")
    return "; ".join(parts)


def _disturbances(c: Context) -> str:
    """Of a drone that tumbles."""
    options, vehicle = c.converted.options, c.converted.race.params.vehicle
    rate = options.sample_rate
    log = motions.tumbling(np.random.default_rng(0), rate, MOTION_SAMPLES / rate)
    exact = motions.estimate_float64(vehicle, log, rate, options.cutoff)
    error = np.abs(c.library.disturbances(log).astype(np.float64) - exact)
    moment, force = float(error[:, :3].max()), float(error[:, 3:].max())
    require(moment <= ESTIMATOR_TOLERANCE[0], f"moment off by {moment:.2g} N m")
    require(force <= ESTIMATOR_TOLERANCE[1], f"force off by {force:.2g} m/s^2")
    return f"{len(log)} samples: {moment:.0e} N m, {force:.0e} m/s^2 from float64"


def _highest(c: Context) -> str:
    """At full power and less in turn as the battery empties."""
    battery, rate = c.converted.in_c.battery, c.converted.options.sample_rate
    constants, rng = c.converted.race.params.vehicle.constants, np.random.default_rng(0)
    assert battery is not None
    log = motions.full_power_bursts(rng, constants, rate, MOTION_SAMPLES / rate)
    exact = motions.highest_float64(constants, battery.first, log, rate)
    worst = float(np.abs(c.library.highest_rpm(log) - exact).max())
    require(worst <= BATTERY_TOLERANCE, f"the highest rpm is off by {worst:.2g} rpm")
    return f"highest speed: {worst:.0e} rpm from float64"


def check_flights(c: Context) -> str:
    """The race in the C is that of the policy file, and the policy finishes it."""
    converted, options = c.converted, c.converted.options
    path, own = c.path / POLICY_FILE, (converted.policy, converted.race)
    is_own = _allowed(
        lambda: check_race(*own, path),
        c.allow_other_race and options.allow_other_race,
        "--allow-other-race",
    )
    finishes = _allowed(
        lambda: flights.check_finished(c.rollouts.laps, converted.race, converted.in_c.name),
        c.allow_unfinished and options.allow_unfinished,
        "--allow-unfinished",
    )
    return f"{is_own}; {finishes}"


def _allowed(check: Callable[[], str], allowed: bool, option: str) -> str:
    """The figure of a check, which an option may allow to fail."""
    try:
        return check()
    except InputError as error:
        if not allowed:
            raise Failed(str(error)) from None
        return f"{error}; allowed by {option}"


CHECKS: dict[str, Callable[[Context], str]] = {
    "files and proof": check_files,
    "network": check_network,
    "observation": check_observation,
    "gates": check_gates,
    "estimators": check_estimators,
    "race and flights": check_flights,
}
