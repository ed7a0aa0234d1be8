"""What flight logs change: a drone's model, the states to train from, and the margin at the gates.

Nothing here knows the stand-in plant: it receives log files and the present model.
"""

import dataclasses
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.stats import chi2

from quadjax.config.assembly import make_choices, make_vehicle
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.evaluation.table import Table
from quadjax.fitting.axes import Prediction, pooled
from quadjax.fitting.config import FitConfig
from quadjax.fitting.fit import Fit
from quadjax.fitting.fit import fit as fit_drone
from quadjax.fitting.motors import BatteryFit, fit_battery
from quadjax.fitting.nominal import AXES, UNITS
from quadjax.fitting.report import write_results
from quadjax.flights.flight import MOTION, Flight, Signal
from quadjax.flights.gates import crossing_after_end, passages
from quadjax.log_states import vehicle_flight
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import read_residual

SPEEDS = "rpm"
LEAST_GAIN = 0.01  # least decrease of the mean error for a model to be accepted
MOST_HARM = 0.1  # largest increase of one quantity's error
STATES = 1024  # that are kept: with one number, all trainings are one compiled program
REACH = 0.5  # m by which openings are wider where a logged position tells the gate ahead
BEFORE = 0.1  # s before a gate's plane at which a flight may end and still count as its passage
SPREAD = 4.0  # standard deviations of the clearance that are to be free
UNSURE = 0.1  # probability that the standard deviation is larger than assumed
AFTER_A_HIT = 0.05  # m, least increase of the margin
MOST = 0.2  # m, largest increase in a round


@dataclasses.dataclass(frozen=True)
class Model:
    """A drone's model, and how it predicts flights that it is not fitted to."""

    constants: dict[str, float]  # of the motor-level model
    residual: str | None = None  # file of the networks; None for none
    battery: BatteryFit | None = None  # the fitted limit; None for no limit
    # root mean square errors of the model before it on the held-out flights, by quantity; without
    # the propeller speeds where the logs have no commanded ones
    before: dict[str, float] = dataclasses.field(default_factory=dict)
    # those of models that are fitted without the flight that they predict
    after: dict[str, float] = dataclasses.field(default_factory=dict)
    rejection: str = ""  # why it is not accepted; "" if it is
    seconds: float = 0.0  # of computing

    @classmethod
    def of(cls, config: Config) -> Self:
        """The model that a race trains with, without its battery, which no flight has shown."""
        names = constant_names(MotorConstants)
        constants = {name: float(config.vehicle.constants[name]) for name in names}
        return cls(constants, config.vehicle.residual)

    @property
    def motor(self) -> MotorConstants:
        """The constants as floats."""
        values: dict[str, Any] = {**self.constants}
        return MotorConstants(**values)

    @property
    def hover(self) -> float:
        """Propeller speed of a hover, rpm."""
        return float(np.sqrt(self.constants["g"] / (4.0 * self.constants["k_w"])))

    @property
    def change(self) -> float:
        """Relative change of the errors, the geometric mean over the quantities."""
        ratios = [self.after[name] / max(old, 1e-300) for name, old in self.before.items()]
        return float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-300)))) - 1.0)

    def race(self, config: Config) -> Config:
        """The race with this model; the policy's observation stays the same."""
        vehicle, observed = config.vehicle, config.observation
        gain = {} if self.residual is None else {"residual_gain": 1.0}
        new = {"constants": {**vehicle.constants, **self.constants}, "residual": self.residual}
        battery = self.limits(config)
        if battery is None:
            battery = config.battery
        elif config.battery is None:
            observed = observed.replace(highest_rpm="none")
        return config.replace(
            vehicle=vehicle.replace(**new, **gain), battery=battery, observation=observed
        )

    def limits(self, config: Config) -> BatteryConfig | None:
        """The battery in a race; None where the flights show none."""
        if self.battery is None:
            return None
        return self.battery.section(config.battery or BatteryConfig())

    @classmethod
    def from_json(cls, values: dict[str, Any], path: Path | None = None) -> Self:
        """The model of ``dataclasses.asdict``; errors name ``path``, the file of ``values``."""
        try:
            battery = values["battery"] and BatteryFit(**values["battery"])
            names = {"refused": "rejection"}  # keys of earlier versions
            values = {names.get(key, key): value for key, value in values.items()}
            return cls(**(values | {"battery": battery}))
        except (KeyError, TypeError):
            raise InputError(
                f"{path}: written by another version of quadjax improve; name a new output folder"
            ) from None


def refit(
    files: Sequence[Path],
    recent: Sequence[Path],
    fit: FitConfig,
    present: Model,
    folder: Path,
    report: Callable[[str], None] = lambda line: None,
    battery: BatteryConfig | None = None,
) -> Model:
    """Fit a model to logs, and compare its predictions with those of the present model.

    The comparison is on the flights ``recent``, which the present model has not seen. Each is
    predicted by a fit without it; of a single flight the last part is held out.

    Args:
        files: logs of one drone.
        recent: those of ``files`` to compare on.
        fit: config of the fit; its files are not used, and its range of speeds is that of the
            present model, which the policy commands.
        present: the model in use.
        folder: for the vehicle file, the residual and the report of the fit.
        report: called with the progress.
        battery: of the race, whose drain is assumed where flights are too short to show it.

    Raises:
        InputError: bad logs, or a fit of impossible constants, in one line.
    """
    started = time.monotonic()
    ends = (present.constants["rpm_min"], present.constants["rpm_max"])
    config = fit.replace(
        logs=fit.logs.replace(files=tuple(str(file) for file in files)),
        body=fit.body.replace(rpm_range=ends),
    )
    base = (battery or BatteryConfig()).filled(present.constants["rpm_max"])
    result = fit_drone(config, Path(), report, base)
    write_results(result, folder)
    motor = result.vehicle.motor
    constants = {name: float(getattr(motor, name)) for name in constant_names(MotorConstants)}
    limit = result.battery or present.battery
    model = Model(constants, str(folder / "residual.npz"), limit)
    names = {file.stem for file in recent}
    before, after = _errors(result, present, names)
    speeds = _speed_errors(result.logs, model, present, names, base)
    if speeds is not None:
        before[SPEEDS], after[SPEEDS] = speeds
    seconds = round(time.monotonic() - started, 1)
    compared = dataclasses.replace(model, before=before, after=after, seconds=seconds)
    return dataclasses.replace(compared, rejection=rejection(compared))


def _errors(
    result: Fit, present: Model, names: set[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Errors of the present model and of the fit on the held-out rows of some flights."""
    flights = [index for index, log in enumerate(result.logs) if log.name in names]
    residual = None if present.residual is None else read_residual(present.residual)
    held, samples = pooled(result.held_out), result.samples
    used = held[np.isin(samples.flight[held.rows], flights)]
    old = Prediction.of(
        "present", samples[used.rows], np.ones(len(used.rows), bool), present.motor, residual
    )
    pairs = (old.rmse(old.full), used.rmse(used.full))
    before, after = (dict(zip(AXES, rmse.tolist(), strict=True)) for rmse in pairs)
    return before, after


def _speed_errors(
    logs: Sequence[Flight], model: Model, present: Model, names: set[str], base: BatteryConfig
) -> tuple[float, float] | None:
    """Errors of the propeller speeds from commands, of the present model and of fits without.

    Loads are relative to the hover of each model. None where no flight can be compared: without
    commanded speeds, or without a second flight.
    """
    commanded = [log for log in logs if "command" in log.signals]
    old = present.battery or BatteryFit(present.constants["tau"], 0.0, 0.0)
    pairs = []
    for log in commanded:
        others = [other for other in commanded if other is not log]
        new = fit_battery(others, model.hover, base)[1] if log.name in names else None
        if new is not None:
            before = old.error(log, present.hover, present.constants["rpm_max"])
            pairs.append((before, new.error(log, model.hover, model.constants["rpm_max"])))
    if not pairs:
        return None
    before, after = np.sqrt(np.mean(np.square(pairs), axis=0)).tolist()
    return before, after


def rejection(model: Model) -> str:
    """Why a model with its errors on held-out flights is rejected; "" if it is not."""
    change = model.change
    if not change <= -LEAST_GAIN:
        than = f"{100.0 * abs(change):.1f}% {'smaller' if change < 0 else 'larger'} than"
        return (
            f"its error on held-out flights is {than} that of the present model, allowed: at least "
            f"{100.0 * LEAST_GAIN:g}% smaller"
        )
    for name, error in model.after.items():
        harm = error / max(model.before[name], 1e-300) - 1.0
        if harm > MOST_HARM:
            return f"its error of {name} on held-out flights is {100.0 * harm:.0f}% larger"
    return ""


def changes(present: Model, model: Model) -> str:
    """Constants, held-out errors and the battery's limit before and after as text."""
    constants = {n: (present.constants[n], new) for n, new in model.constants.items()}
    parts = {n: pair for n, pair in constants.items() if pair[0] != pair[1]}
    units, first = UNITS | {SPEEDS: "rpm"}, len(parts)
    parts |= {f"{n} ({units[n]})": (old, model.after[n]) for n, old in model.before.items()}
    rows = [
        [name, f"{old:.5g}", f"{new:.5g}", f"{100.0 * (new / (old or 1e-300) - 1.0):+.1f}%"]
        for name, (old, new) in parts.items()
    ]
    rows = [["constants"], *rows[:first], ["held out"], *rows[first:]]
    battery, notes = model.battery, []
    if battery is not None and not battery.converged:
        notes.append("warning: the fit of the battery stopped before it converged")
    if battery is None:
        notes.append("battery: not fitted, as no log has commanded propeller speeds")
    elif not battery.first:
        notes.append("battery: no limit of the propeller speeds found")
    else:
        low, high = min(battery.first.values()), max(battery.first.values())
        notes.append(
            f"battery: highest speed {low:.0f} to {high:.0f} rpm without load at the start, "
            f"{battery.sag:.0f} rpm less at the load of hover, {battery.drain:.1f} rpm less per "
            "second of hover"
        )
    return Table(["", "present", "refitted", "change"], rows, notes).format()


def _flight(log: Flight, config: Config) -> Flight | None:
    """A log as a flight with its passages, whose end is none; None without position or attitude."""
    try:
        flight = vehicle_flight(log, make_choices(config).model, make_vehicle(config))
    except InputError:
        return None
    gates, closed = config.track.gates, config.track.closed
    path = flight.time, flight["position"]
    passed = passages(*path, gates, reach=REACH, closed=closed, cut=False)
    return flight.replace(gates=gates, passages=passed)


def states_of_logs(logs: Sequence[Flight], config: Config) -> Flight | None:
    """``STATES`` states at even intervals of the flights, with the gate ahead of each.

    Logs without a position, a passage of the first gate, or propeller speeds give none; None if no
    log gives any.
    """
    flights = [flight for log in logs if (flight := _flight(log, config)) is not None]
    flights = [f for f in flights if len(f.passages) and "actuators" in f.signals]
    if not flights:
        return None
    target = np.concatenate([flight.target for flight in flights])
    rows = np.linspace(0, len(target) - 1, STATES).round().astype(int)
    signals = {"target": Signal(target[rows, None].astype(np.float64))}
    for name in (*MOTION, "actuators"):
        values = np.concatenate([flight[name] for flight in flights])[rows]
        signals[name] = dataclasses.replace(flights[0].signals[name], values=values)
    return Flight("states", np.arange(STATES, dtype=np.float64), signals)


def clearances(
    logs: Sequence[Flight], config: Config, hit: Collection[str] = ()
) -> dict[int, np.ndarray]:
    """Distances (n,) from the edge of the opening at the passages of each gate, m.

    Args:
        logs: of the flights.
        config: of the race.
        hit: names of the logs that end at a gate. This end is a passage too, with the position at
            the plane of the gate, so its distance is negative or nearly zero.
    """
    by_gate: dict[int, list[float]] = {}
    for log in logs:
        flight = _flight(log, config)
        if flight is None:
            continue
        for _, number, clear in flight.passages.tolist():
            by_gate.setdefault(int(number), []).append(clear)
        ahead = len(flight.passages) % len(flight.gates)
        path = flight.time, flight["position"]
        end = crossing_after_end(*path, flight.gates[ahead], BEFORE) if log.name in hit else None
        if end is not None:
            by_gate.setdefault(ahead, []).append(end[1])
    return {number: np.array(values) for number, values in sorted(by_gate.items())}


def spread_of(clearance: dict[int, np.ndarray]) -> float:
    """Standard deviation of clearances around the mean of their gate, m, as an upper bound.

    With few passages it is larger than the estimate, by the distribution of a variance: smaller
    than the true one only with a probability of ``UNSURE``. NaN without a second passage.
    """
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in clearance.values())
    free = sum(len(values) - 1 for values in clearance.values())
    return float(np.sqrt(squares / chi2.ppf(UNSURE, free))) if free > 0 else float("nan")


def margin_of(config: Config, logs: Sequence[Flight], hit: Collection[str]) -> float:
    """The margin inside the gates' edges, m, that flights call for: ``reward.gate_edge_margin``.

    It grows by what ``SPREAD`` standard deviations of the clearance exceed its mean at the gate
    with the smallest mean, by at least ``AFTER_A_HIT`` where a flight hit a gate. A reward without
    a penalty near the edges has no margin to change.

    Args:
        config: of the training before.
        logs: the flights of its policy.
        hit: names of the flights that hit a gate; the checks may reject some of their logs.
    """
    now = config.reward.gate_edge_margin
    if config.reward.gate_edge == 0:
        return now
    by_gate = clearances(logs, config, hit)
    smallest = min((float(values.mean()) for values in by_gate.values()), default=np.inf)
    needed = SPREAD * spread_of(by_gate) - smallest
    more = max(needed if np.isfinite(needed) else 0.0, AFTER_A_HIT if hit else 0.0, 0.0)
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    largest = max(now, 0.5 * (half - config.rules.body_radius))
    return round(min(now + min(more, MOST), largest), 3)
