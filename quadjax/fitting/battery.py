"""The battery's limit of the propeller speeds, and the motors' lag under it, from commands.

A motor of first order follows its command, limited to the highest speed that the battery permits
(``quadjax.vehicle.battery.highest_rpm``):

    tau w' = min(u, top) - w,    top = a - b load - c integral of load,

``load`` is the rotors' power over that of hover, and ``a`` a number of each flight, as batteries
are charged differently. ``tau``, ``b``, ``c`` and each ``a`` are fitted by least squares on
simulated speeds, so noise of the measured ones does not bias them. No voltage is needed. Short
flights do not show ``c``, because the charge hardly falls; it is then that of a given battery.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares

from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import LONGEST, SHORTEST
from quadjax.fitting.signals import first_order
from quadjax.vehicle.battery import BatteryConfig

RATE = 100.0  # Hz, at which errors are compared
LEAST_GAIN = 0.02  # relative decrease of the error, below which there is no limit
RESERVE = 0.1  # charge above and below that of the flights, for flights to come
UNIT = 1000.0  # rpm
LEAST_USED = 20.0  # s of hover in the longest flight, below which the drain is not fitted
START = 0.05  # s, the lag from which the search starts


@dataclass(frozen=True)
class Speeds:
    """Speeds and commands of one flight."""

    rpm: np.ndarray  # (n, 4)
    command: np.ndarray  # (n, 4)
    rate: float  # Hz
    load: np.ndarray  # (n,) power over that of hover
    used: np.ndarray  # (n,) s of hover

    @classmethod
    def of(cls, log: FlightLog, hover: float) -> "Speeds":
        """Those of a log with commands, for a drone that hovers at ``hover`` rpm.

        Raises:
            InputError: a log without commanded speeds.
        """
        if log.rpm_command is None:
            raise InputError(f"{log.path}: no commanded speeds (logs.columns.rpm_command)")
        load = ((log.rpm / hover) ** 3).mean(axis=1)
        used = np.cumsum(load) / log.sample_rate
        return cls(log.rpm, log.rpm_command, log.sample_rate, load, used)

    def error(self, tau: float, top: np.ndarray | float) -> np.ndarray:
        """Simulated minus measured speeds (m, 4), rpm, under limits ``top`` (n,) rpm."""
        limited = np.minimum(self.command, np.broadcast_to(top, self.load.shape)[:, None])
        simulated = first_order(limited, self.rpm[0], tau, 1.0 / self.rate)
        return (simulated - self.rpm)[:: max(1, round(self.rate / RATE))]


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
        """
        part = Speeds.of(log, hover)
        top = np.full(len(part.load), highest)
        if self.first:
            mean = float(np.mean(list(self.first.values())))
            top = mean - self.sag * part.load - self.drain * part.used
        return _rmse(part.error(self.tau, top))

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


def fit_battery(
    logs: Sequence[FlightLog],
    hover: float,
    base: BatteryConfig,
) -> BatteryFit | None:
    """Fit the limit over flights with commanded speeds; None without any.

    Args:
        logs: flights of one drone.
        hover: propeller speed of a hover, rpm.
        base: the battery whose drain is assumed where flights are too short to show it.
    """
    parts = {log.name: Speeds.of(log, hover) for log in logs if log.rpm_command is not None}
    if not parts:
        return None

    flights = list(parts.values())
    has_drain = max(p.used[-1] for p in flights) >= LEAST_USED

    def error(x: np.ndarray) -> np.ndarray:
        c = x[2] if has_drain else drain_of(base) / UNIT
        tops = [
            UNIT * (a - x[1] * p.load - c * p.used) for a, p in zip(x[3:], flights, strict=True)
        ]
        tau = float(np.exp(x[0]))
        return np.concatenate([p.error(tau, top) for p, top in zip(flights, tops, strict=True)])

    first = [(np.percentile(p.rpm, 99.0) / UNIT + 0.1 * np.median(p.load)) for p in flights]
    free = np.array([np.log(START), 0.0, 0.0, *np.full(len(flights), np.inf)])
    tau, converged = _least(lambda x: error(np.array([*x, *free[1:]])), free[:1])
    without = _rmse(error(np.array([*tau, *free[1:]])))
    x, limit_converged = _least(error, np.array([np.log(START), 0.1, 0.001, *first]))
    rmse = _rmse(error(x))
    if rmse > (1.0 - LEAST_GAIN) * without:
        return BatteryFit(float(np.exp(tau[0])), 0.0, 0.0, rmse=without, converged=converged)
    sag, drain = UNIT * float(x[1]), UNIT * float(x[2]) if has_drain else drain_of(base)
    begin = {name: UNIT * float(a) for name, a in zip(parts, x[3:], strict=True)}
    end = {name: begin[name] - drain * float(part.used[-1]) for name, part in parts.items()}
    return BatteryFit(float(np.exp(x[0])), sag, drain, begin, end, rmse, limit_converged)


def _rmse(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).mean()))


def _least(error: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> tuple[np.ndarray, bool]:
    """Least squares over the logarithm of tau and numbers of at least zero; if it converged."""
    low = np.array([np.log(SHORTEST), *np.zeros(len(start) - 1)])
    high = np.array([np.log(LONGEST), *np.full(len(start) - 1, np.inf)])
    solution = least_squares(lambda x: error(x).ravel() / UNIT, start, bounds=(low, high))
    return solution.x, bool(solution.success)
