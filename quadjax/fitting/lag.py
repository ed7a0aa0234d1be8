"""First-order lags of signals that follow commands, and the battery's limit of the motors.

The model ``y' = (u - y) / tau`` is simulated from the commands and compared with the measurement,
so noise in the measured signal does not bias the result, as it does when the derivative is
regressed on ``u - y``. It is the lag of the motors (propeller speeds) and, for the rate-and-thrust
model, that of the inner loop (body rates, and specific thrust).

The battery limits the speeds that motors follow (``quadjax.vehicle.battery.highest_rpm``):

    tau w' = min(u, top) - w,    top = a - sag load - drain integral of load,

``load`` is the rotors' power over that of hover, and ``a`` a number of each flight, as batteries
are charged differently. No voltage is needed. Short flights do not show the drain, because the
charge hardly falls; it is then that of a given battery.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.regression import Estimate, Search, half_seconds, solve, unknown
from quadjax.fitting.signals import first_order
from quadjax.vehicle.battery import BatteryConfig

SHORTEST, LONGEST = 0.002, 0.5  # s
START, UNIT = 0.05, 0.05  # s, of a search
LEAST_GAIN = 0.02  # relative decrease of the error, below which there is no limit
RESERVE = 0.1  # charge above and below that of the flights, for flights to come
LEAST_USED = 20.0  # s of hover in the longest flight, below which the drain is not fitted
LEAST_CHANGE = 20.0  # rpm, of the commands
RPM = 1000.0  # unit of the search
LIMIT = ("tau", "sag", "drain")


@dataclass(frozen=True)
class Followed:
    """Signals that follow commands, in some rows of one flight.

    Attributes:
        measured: (n, k).
        command: (n, k).
        rate: Hz.
        starts: rows at which a contiguous part begins.
        time: (n,) s.
        load: (n,) power over that of hover; of propeller speeds only.
        used: (n,) s of hover since the start of the flight.
    """

    measured: np.ndarray
    command: np.ndarray
    rate: float
    starts: np.ndarray
    time: np.ndarray
    load: np.ndarray | float = 0.0
    used: np.ndarray | float = 0.0

    def simulated(self, tau: float, command: np.ndarray) -> np.ndarray:
        """The signals (n, k) that follow other commands (n, k), each held until the next sample."""
        pieces = zip(
            np.split(self.measured, self.starts[1:]),
            np.split(command, self.starts[1:]),
            strict=True,
        )
        return np.concatenate([first_order(u, y[0], tau, 1.0 / self.rate) for y, u in pieces])

    def limited(self, tau: float, first: float, sag: float, drain: float) -> np.ndarray:
        """Propeller speeds (n, 4), rpm, under the limit ``first - sag load - drain used``."""
        top = first - sag * self.load - drain * self.used
        limit = np.broadcast_to(top, self.time.shape)[:, None]
        return self.simulated(tau, np.minimum(self.command, limit))


def followed(
    log: FlightLog, rows: np.ndarray, measured: np.ndarray, command: np.ndarray
) -> Followed:
    """Some rows (n,) bool of signals (n, k) and their commands."""
    index = np.flatnonzero(rows)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 1]))
    return Followed(measured[rows], command[rows], log.sample_rate, starts, log.time[rows])


def blocks_of(parts: Sequence[Followed]) -> np.ndarray:
    """Index of the half second of one flight, of the rows of all parts."""
    flight = np.repeat(np.arange(len(parts)), [len(part.time) for part in parts])
    return half_seconds(np.concatenate([part.time - part.time[0] for part in parts]), flight)


def fit_lag(
    parts: Sequence[Followed],
    base: float,
    name: str,
    what: str,
    least_change: float,
    least_explained: float = -np.inf,
) -> Estimate:
    """Fit one time constant over several flights.

    Args:
        parts: of the flights that have commands.
        base: value without evidence, s.
        name: of the constant.
        what: the signals, for messages.
        least_change: of the commands, in their unit.
        least_explained: R^2 below which the base value is kept.
    """
    if not parts:
        return unknown(name, {name: base}, f"the logs have no commanded {what}")
    if all(np.ptp(part.command, axis=0).max() < least_change for part in parts):
        return unknown(name, {name: base}, f"the commanded {what} never change")

    def model(values: np.ndarray) -> np.ndarray:
        return np.concatenate([part.simulated(values[0], part.command) for part in parts])

    problem = Search(
        group=name,
        names=(name,),
        base=np.array([base]),
        measured=np.concatenate([part.measured for part in parts]),
        blocks=blocks_of(parts),
        least_explained=least_explained,
        model=model,
        low=np.array([SHORTEST]),
        high=np.array([LONGEST]),
        unit=np.array([UNIT]),
    )
    return solve(problem)


@dataclass(frozen=True)
class BatteryFit:
    """The motors' lag, and the limit where there is one.

    Attributes:
        tau: s.
        sag: rpm per load; 0 without a limit.
        drain: rpm per s of hover.
        first: rpm at no load at the start of each flight, by its name; empty without a limit.
        last: the same at the end.
        rmse: of the simulated speeds of the flights, rpm.
        converged: false if the solver stopped at its limit of steps.
    """

    tau: float
    sag: float
    drain: float
    first: dict[str, float] = field(default_factory=dict)
    last: dict[str, float] = field(default_factory=dict)
    rmse: float = 0.0
    converged: bool = True

    def error(self, log: FlightLog, hover: float, highest: float) -> float:
        """Root mean square error, rpm, of the speeds of a flight that was not fitted.

        Its charge is not known, so ``a`` is the mean over the fitted flights.

        Raises:
            InputError: a log without commanded speeds.
        """
        if log.rpm_command is None:
            raise InputError(f"{log.path}: no commanded speeds (logs.columns.rpm_command)")
        part = _speeds(log, np.ones(len(log.time), bool), hover)
        first = float(np.mean(list(self.first.values()))) if self.first else highest
        simulated = part.limited(self.tau, first, self.sag, self.drain)
        return float(np.sqrt(((simulated - part.measured) ** 2).mean()))

    def section(self, base: BatteryConfig) -> BatteryConfig | None:
        """The battery of a race; None without a limit.

        The speed at the full voltage and the charge of a flight cannot be separated: the flight
        with the highest limit is assumed to start ``RESERVE`` below full. Voltages and the hover
        current are those of ``base``.
        """
        if not self.first:
            return None
        drop = base.drop / base.voltage
        full = max(self.first.values()) / (1.0 - drop * RESERVE)
        lowest = 1.0 - (1.0 - min(self.last.values()) / full) / max(drop, 1e-6) - RESERVE
        per_second = max(self.drain / (full * max(drop, 1e-6)), 1e-8)
        return base.replace(
            rpm_full=round(full, 2),
            resistance=round(self.sag / full * base.voltage / base.hover_current, 6),
            capacity=round(base.hover_current / (3600.0 * per_second), 5),
            charge=(round(float(np.clip(lowest, 0.0, 1.0)), 3), 1.0),
        )


def drain_of(battery: BatteryConfig) -> float:
    """Decrease of the highest speed per second of hover, rpm/s, by a battery's capacity."""
    part = battery.hover_current / (3600.0 * battery.capacity)
    return battery.rpm_full * battery.drop / battery.voltage * part


def fit_battery(logs: Sequence[FlightLog], hover: float, base: BatteryConfig) -> BatteryFit | None:
    """Fit lag and limit of the motors over flights with commanded speeds; None without any.

    Args:
        logs: flights of one drone.
        hover: propeller speed of a hover, rpm.
        base: the battery whose drain is assumed where flights are too short to show it.
    """
    rows = [np.ones(len(log.time), bool) for log in logs]
    return fit_motor_lag(logs, rows, START, hover, base)[1]


def fit_motor_lag(
    logs: Sequence[FlightLog],
    rows: Sequence[np.ndarray],
    tau: float,
    hover: float,
    base: BatteryConfig,
) -> tuple[Estimate, BatteryFit | None]:
    """Fit the motors' lag, with the battery's limit if that decreases the error.

    Args:
        logs: flights of one drone.
        rows: of each, (n,) bool.
        tau: value without evidence, s.
        hover: propeller speed of a hover, rpm.
        base: the battery whose numbers are assumed where the flights do not show them.

    Returns:
        The constants ``tau``, and ``sag`` and ``drain`` with a limit; and the limit, None if no
        flight has commanded speeds.
    """
    parts = {
        log.name: _speeds(log, used, hover)
        for log, used in zip(logs, rows, strict=True)
        if log.rpm_command is not None and used.any()
    }
    lag = fit_lag(list(parts.values()), tau, "tau", "propeller speeds", LEAST_CHANGE)
    lag = replace(lag, group="motors")
    if not parts:
        return lag, None
    limit = _fit_limit(parts, lag.constants["tau"], base)
    if not limit.rmse < (1.0 - LEAST_GAIN) * lag.rmse:
        free = BatteryFit(lag.constants["tau"], 0.0, 0.0, rmse=lag.rmse, converged=lag.converged)
        return lag, free
    found = limit.constants
    begin = {name: found[name] for name in parts}
    ends = {name: begin[name] - found["drain"] * part.used[-1] for name, part in parts.items()}
    last = {name: float(end) for name, end in ends.items()}
    tau, sag, drain = (found[name] for name in LIMIT)
    battery = BatteryFit(tau, sag, drain, begin, last, limit.rmse, limit.converged)
    count = len(LIMIT)
    of_drone = replace(
        limit,
        names=LIMIT,
        values=limit.values[:count],
        standard_errors=limit.standard_errors[:count],
    )
    return of_drone, battery


def _speeds(log: FlightLog, rows: np.ndarray, hover: float) -> Followed:
    load = ((log.rpm / hover) ** 3).mean(axis=1)
    used = np.cumsum(load) / log.sample_rate
    return replace(followed(log, rows, log.rpm, log.rpm_command), load=load[rows], used=used[rows])


def _fit_limit(parts: dict[str, Followed], tau: float, base: BatteryConfig) -> Estimate:
    flights = list(parts.values())
    has_drain = max(part.used[-1] for part in flights) >= LEAST_USED
    first = [np.percentile(p.measured, 99.0) + 0.1 * RPM * np.median(p.load) for p in flights]
    sag = base.rpm_full * base.resistance * base.hover_current / base.voltage

    def model(values: np.ndarray) -> np.ndarray:
        tau, sag, drain, *begin = values
        pairs = zip(flights, begin, strict=True)
        return np.concatenate([part.limited(tau, top, sag, drain) for part, top in pairs])

    count = len(flights)
    problem = Search(
        group="motors",
        names=(*LIMIT, *parts),
        base=np.array([tau, sag, drain_of(base), *first]),
        measured=np.concatenate([part.measured for part in flights]),
        blocks=blocks_of(flights),
        positive=("sag", "drain"),
        small=("sag", "drain"),
        model=model,
        low=np.array([SHORTEST, 0.0, 0.0, *np.zeros(count)]),
        high=np.array([LONGEST, *np.full(2 + count, np.inf)]),
        unit=np.array([UNIT, RPM, 1.0, *np.full(count, RPM)]),
        physical=("sag", "drain"),
        fixed=() if has_drain else ("drain",),
    )
    return solve(problem)
