"""First-order lags of signals that follow commands: motors, battery limit, motor map, inner loop.

The model ``y' = (s(u) - y) / tau`` is simulated from the commands u and compared with the
measurement, so noise in the measured signal does not bias the result, as it does when the
derivative is regressed on ``s(u) - y``. The steady value s(u) is

- of propeller speeds, body rates and specific thrust: the command;
- of propeller speeds under a battery's limit: ``min(u, top)``,
  ``top = a - sag load - drain integral of load`` (``quadjax.vehicle.battery.highest_rpm``). The
  load is the rotors' power over that of hover, and ``a`` a number of each flight, as batteries are
  charged differently. No voltage is needed. Short flights do not show the drain, because the charge
  hardly falls; it is then that of the base battery;
- of motor commands from 0 to 1: ``w_min + (w_max - w_min) sqrt(k u^2 + (1 - k) u)``. Without
  measured speeds, the forces and moments of the simulated speeds are compared with the measured
  ones; the scale of the speeds then has no effect, and ``w_max`` is that of the base vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from quadjax.fitting.axes import fit_axes
from quadjax.fitting.lags import (
    BETWEEN,
    TAU_RANGE_S,
    Followed,
    between_rows,
    fit_lag,
    followed,
    lag_problem,
    never_follow,
    partly,
    slowest,
    solve_changing,
    solve_held,
    solve_lag,
)
from quadjax.fitting.nominal import AXES, EQUATIONS
from quadjax.fitting.regression import Estimate, Parameter, Problem, half_seconds, unknown
from quadjax.fitting.samples import CUTOFF_HZ, filtered_regressors, prepare
from quadjax.fitting.signals import derivative, first_order, low_pass
from quadjax.flights.flight import MOTORS, Flight, Signal
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.rate import RateConstants

MAP = ("tau", "w_min", "w_max", "k")
LEAST_GAIN = 0.02  # relative decrease of the error, below which there is no limit
LEAST_HOVER_S = 20.0  # of hover in the longest flight, below which the drain is not fitted
LEAST_EXPLAINED = 0.2  # R^2 of a lag of the inner loop that is used
START = "highest rpm at the start of "  # before the name of a flight
EXPLAINED = 0.9  # R^2 of the motor map below which there is a warning
LEAST_RATE_HZ = 60.0  # of the samples compared without measured speeds


@dataclass(frozen=True)
class BatteryFit:
    """The motors' lag, and the limit where there is one."""

    tau: float  # s
    sag: float  # rpm per load; 0 without a limit
    drain: float  # rpm per s of hover
    # rpm at no load at the start of each flight, by its name; empty without a limit
    first: dict[str, float] = field(default_factory=dict)
    last: dict[str, float] = field(default_factory=dict)  # the same at the end
    rmse: float = 0.0  # of the simulated speeds of the flights, rpm
    converged: bool = True  # false if the solver stopped at its limit of steps


def compute_drain(battery: BatteryConfig) -> float:
    """Decrease of the highest speed per second of hover, rpm/s, by a battery's capacity."""
    assert battery.rpm_full is not None
    part = battery.hover_current / (3600.0 * battery.capacity)
    return battery.rpm_full * battery.drop / battery.voltage * part


def fit_battery(
    logs: Sequence[Flight],
    hover: float,
    base: BatteryConfig,
    rows: Sequence[np.ndarray],
    tau: float,
) -> tuple[Estimate, BatteryFit | None]:
    """Fit the motors' lag, with the battery's limit if that decreases the error.

    Args:
        logs: flights of one drone.
        hover: propeller speed of a hover, rpm.
        base: the battery whose drain is assumed where flights are too short to show it.
        rows: of each log, (n,) bool.
        tau: value without evidence, s.

    Returns:
        The constants ``tau``, and ``sag`` and ``drain`` with a limit; and the limit, None if no
        flight has commanded speeds.
    """
    parts = {
        log.name: followed(log, used, "actuators", "command", hover)
        for log, used in zip(logs, rows, strict=True)
        if "command" in log.signals and used.any()
    }
    flights = list(parts.values())
    first = Parameter("tau", tau, *TAU_RANGE_S)
    lag = fit_lag(flights, "motors", first, "commanded propeller speeds")
    if not parts:
        return lag, None
    first = first._replace(base=lag.constants["tau"])
    limit = _fit_limit(parts, first, base, BETWEEN in lag.constants)
    if not limit.rmse < (1.0 - LEAST_GAIN) * lag.rmse:
        return lag, BatteryFit(first.base, 0.0, 0.0, rmse=lag.rmse, converged=lag.converged)
    values = limit.constants
    at_start = {name: values[START + name] for name in parts}
    drain = values["drain"]
    at_end = {name: float(at_start[name] - drain * part.used[-1]) for name, part in parts.items()}
    fitted = values["tau"], values["sag"], drain, at_start, at_end, limit.rmse, limit.converged
    of_drone = {name: value for name, value in values.items() if not name.startswith(START)}
    return replace(limit, constants=of_drone), BatteryFit(*fitted)


def _fit_limit(
    parts: dict[str, Followed], tau: Parameter, base: BatteryConfig, changing: bool
) -> Estimate:
    """The lag under a limit; ``changing`` whether commands change between rows."""
    assert base.rpm_full is not None
    flights = list(parts.values())
    sag = base.rpm_full * base.resistance * base.hover_current / base.voltage
    has_drain = max(part.used[-1] for part in flights) >= LEAST_HOVER_S
    physical: dict[str, Any] = {"low": 0.0, "positive": True, "small": True, "physical": True}
    starts = [
        Parameter(
            f"{START}{name}",
            np.percentile(part.measured, 99.0) + 100.0 * np.median(part.load),
            0.0,
            size=1e3,
        )
        for name, part in parts.items()
    ]
    problem = lag_problem(
        flights,
        lambda values, index, part: part.limited(values[3 + index], values[1], values[2]),
        group="motors",
        parameters=[
            tau,
            Parameter("sag", sag, size=1000.0, **physical),
            Parameter("drain", compute_drain(base), fixed=not has_drain, **physical),
            *starts,
        ],
    )
    return solve_changing(problem) if changing else solve_held(problem)


def fit_rate_model(
    logs: Sequence[Flight], rows: Sequence[np.ndarray], base: RateConstants
) -> list[Estimate]:
    """Fit the rate-and-thrust model (INDI) over the flights with commanded rates and thrust.

    Drag is fitted to the accelerometer's other two axes. The commands' limits are choices, not
    properties of the drone: those of the base vehicle are kept. ``rows`` (n,) bool of each flight
    are used.

    Returns:
        The estimates; empty if no flight has the commands.
    """
    pairs = [
        (log, used)
        for log, used in zip(logs, rows, strict=True)
        if {"rate_command", "thrust_command"} <= set(log.signals) and used.any()
    ]
    if not pairs:
        return []
    rates = [followed(log, used, "rates", "rate_command") for log, used in pairs]
    forces = [followed(log, used, "specific_force", "thrust_command") for log, used in pairs]
    thrusts = [part._replace(measured=-part.measured[:, 2:]) for part in forces]
    lags = [
        fit_lag(
            parts,
            name,
            Parameter(name, float(getattr(base, name)), *TAU_RANGE_S),
            what,
            LEAST_EXPLAINED,
        )
        for name, parts, what in (
            ("tau_rate", rates, "commanded body rates"),
            ("tau_thrust", thrusts, "commanded thrust"),
        )
    ]
    samples = prepare([log for log, _ in pairs], base, [used for _, used in pairs])
    return [replace(estimate, group="rate") for estimate in (*lags, *fit_axes(samples, base))]


def steady_speeds(values: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Steady speeds, rad/s, of commands in [0, 1], both (n, 4); values as ``MAP``."""
    _, low, high, k = values
    u = np.clip(command, 0.0, 1.0)
    return low + (high - low) * np.sqrt(k * u * u + (1.0 - k) * u)


def with_simulated_speeds(log: Flight, values: np.ndarray, between: float = 0.0) -> Flight:
    """A log with the speeds that its motor commands give; unchanged where they are measured.

    The speeds at its start are not known; see ``settled``. ``between`` is the part of the commands'
    change between two rows (``quadjax.fitting.lags``).
    """
    if "actuators" in log.signals:
        return log
    command = log["motor_command"]
    start = RPM_PER_RAD_S * steady_speeds(values, command[0])
    if between:
        command = partly(command, between_rows(command), between)
    steady = RPM_PER_RAD_S * steady_speeds(values, command)
    rpm = first_order(steady, start, values[0], 1.0 / log.sample_rate)
    return log.replace(signals=log.signals | {"actuators": Signal(rpm, "rpm", MOTORS)})


def fit_motors(
    logs: Sequence[Flight], rows: Sequence[np.ndarray], base: RacingConstants
) -> Estimate:
    """Fit the motor map and time constant of a racing quadcopter, in the order of ``MAP``.

    Rows (n,) bool of flights with motor commands are used; ``base`` has values without evidence.
    """
    values = {name: float(getattr(base, name)) for name in MAP}
    pairs = zip(logs, rows, strict=True)
    flights = [(log, used) for log, used in pairs if "motor_command" in log.signals and used.any()]
    commands = [log["motor_command"][used] for log, used in flights]
    reason = never_follow(commands, "motor commands")
    if reason:
        return unknown("motors", values, reason)
    signals = [
        followed(log, used, "actuators", "motor_command")
        for log, used in flights
        if "actuators" in log.signals
    ]
    measured = [part._replace(measured=part.measured / RPM_PER_RAD_S) for part in signals]
    if measured:
        high = max(*(float(part.measured.max()) for part in measured), values["w_max"])
        limits = {"w_min": (0.0, 0.9 * high), "w_max": (0.1 * high, 10.0 * high)}
    else:
        limits = {"w_min": (0.0, 0.5 * values["w_max"]), "w_max": (0.0, np.inf)}
    options: dict[str, Any] = {
        "group": "motors",
        "uncertain": EQUATIONS[RacingConstants].uncertain,
        "parameters": [
            Parameter("tau", values["tau"], *TAU_RANGE_S),
            Parameter("w_min", values["w_min"], *limits["w_min"], 1000.0, physical=True),
            Parameter("w_max", values["w_max"], *limits["w_max"], 1000.0, fixed=not measured),
            Parameter("k", values["k"], 0.0, 1.0, physical=True),
        ],
    }
    if measured:
        problem = lag_problem(
            measured, lambda at, i, part: steady_speeds(at[: len(MAP)], part.command), **options
        )
        estimate = solve_lag(problem, slowest(measured))
    else:
        problem = _unmeasured(flights, base, options)
        estimate = solve_lag(problem, min(log.sample_rate for log, _ in flights))
    if estimate.r_squared >= EXPLAINED:
        return estimate
    line = (
        f"motors: the commands explain the motors by an R^2 of {estimate.r_squared:.2f}: is "
        "logs.motor_range right?"
    )
    return replace(estimate, warnings=(*estimate.warnings, line))


def _unmeasured(
    flights: Sequence[tuple[Flight, np.ndarray]], base: RacingConstants, options: dict[str, Any]
) -> Problem:
    """Forces and moments with the best constants of the rotors for motors of some values."""
    rows = [
        np.flatnonzero(used)[:: max(1, int(log.sample_rate / LEAST_RATE_HZ))]
        for log, used in flights
    ]
    signals = []
    for (log, _), index in zip(flights, rows, strict=True):
        turn = derivative(low_pass(log["rates"], log.sample_rate, CUTOFF_HZ), log.sample_rate)
        force = low_pass(log["specific_force"][:, 2:], log.sample_rate, CUTOFF_HZ)
        signals.append(np.concatenate([force, turn], axis=1)[index])
    measured = np.concatenate(signals)
    measured = measured / measured.std(axis=0)

    def model(values: np.ndarray) -> np.ndarray:
        logs = [with_simulated_speeds(log, values[:-1], values[-1]) for log, _ in flights]
        parts = [filtered_regressors(log, base) for log in logs]
        modeled = np.empty_like(measured)
        for i, axis in enumerate(AXES[2:]):
            pairs = zip(parts, rows, strict=True)
            columns = np.concatenate([part[axis][index] for part, index in pairs])
            columns = columns / np.sqrt((columns**2).mean(axis=0))
            modeled[:, i] = columns @ np.linalg.lstsq(columns, measured[:, i], rcond=1e-10)[0]
        return modeled

    pairs = zip(flights, rows, strict=True)
    blocks = half_seconds([log.time[index] - log.time[0] for (log, _), index in pairs])
    return Problem(model=model, measured=measured, blocks=blocks, **options)
