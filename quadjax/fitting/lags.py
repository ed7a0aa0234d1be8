"""A first-order lag of signals behind their commands, in rows of flights.

A control loop holds each command until its next step. A log that has a row for each step shows all
of them: each command is held until the next row. A slower log lacks the commands between its rows,
and commands that were held until the next row would be late by up to half a sample, by which the
fitted lag would be too short. There the commands change from row to row as a cubic spline, in the
part ``BETWEEN`` that explains the signals best: ``1 - 1/k`` where every k-th step is logged.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from quadjax.fitting.regression import (
    Estimate,
    Parameter,
    Problem,
    half_seconds,
    solve,
    unknown,
)
from quadjax.fitting.signals import first_order
from quadjax.flights.flight import Flight

TAU_RANGE_S = (0.002, 0.5, 0.05)  # s: lowest, highest and typical time constant
BETWEEN = "between"  # part of the commands' change between two rows, from 0 (held) to 1
CLEARLY = 3.0  # standard errors above zero, from which on commands change between the rows
NODES = np.array([0.5 - np.sqrt(1.0 / 12.0), 0.5 + np.sqrt(1.0 / 12.0)])  # of Gauss, in a sample
LEAST_CHANGE = {  # of commands, by their name in messages
    "commanded propeller speeds": 20.0,
    "motor commands": 0.01,
    "commanded body rates": 0.05,
    "commanded thrust": 0.2,
}

Steady = Callable[[np.ndarray, int, "Followed"], np.ndarray]  # of values, flight index and flight


class Followed(NamedTuple):
    """Signals that follow commands, in some rows of one flight."""

    measured: np.ndarray  # (n, k)
    command: np.ndarray  # (n, k), or (2, n, k) at the times ``NODES`` of each sample
    spline: np.ndarray  # (2, n, k) the same as a cubic spline
    rate: float  # Hz
    starts: np.ndarray  # rows at which a contiguous part begins
    time: np.ndarray  # (n,) s since the first
    load: np.ndarray  # (n,) power over that of hover; of propeller speeds only
    used: np.ndarray  # (n,) s of hover since the start of the flight

    def simulated(self, tau: float, steady: np.ndarray) -> np.ndarray:
        """Signals (n, k) with the steady values of the commands, of their shape."""
        edges = [*self.starts.tolist(), len(self.measured)]
        pieces = (slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True))
        return np.concatenate(
            [
                first_order(steady[..., rows, :], self.measured[rows][0], tau, 1.0 / self.rate)
                for rows in pieces
            ]
        )

    def limited(self, first: float, sag: float, drain: float) -> np.ndarray:
        """Commands, rpm, under the limit ``first - sag load - drain used``."""
        return np.minimum(self.command, (first - sag * self.load - drain * self.used)[:, None])


def partly(command: np.ndarray, spline: np.ndarray, part: float) -> np.ndarray:
    """Commands (n, k), or (2, n, k) at ``NODES``, of which a part changes between the rows."""
    return command + part * (spline - command) if part else command


def between_rows(command: np.ndarray) -> np.ndarray:
    """Commands (2, n, k) at ``NODES`` of each sample, as a cubic spline; the last one is held."""
    rows = np.arange(len(command))
    at = np.minimum(rows + NODES[:, None], rows[-1])
    # A spline beyond the limits of the commands is not one of a motor.
    return np.clip(CubicSpline(rows, command)(at), command.min(axis=0), command.max(axis=0))


def followed(
    log: Flight, rows: np.ndarray, measured: str, command: str, hover: float | None = None
) -> Followed:
    """Some rows (n,) bool of signals and their commands; load and use with a hover, rpm."""
    index = np.flatnonzero(rows)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 1]))
    load = np.zeros(len(rows)) if hover is None else ((log["actuators"] / hover) ** 3).mean(axis=1)
    used, time = np.cumsum(load) / log.sample_rate, log.time[rows] - log.time[index[0]]
    commands = log[command][rows], between_rows(log[command])[:, rows]
    return Followed(
        log[measured][rows], *commands, log.sample_rate, starts, time, load[rows], used[rows]
    )


def never_follow(commands: Sequence[np.ndarray], what: str) -> str:
    """Why a lag behind commands (n, k) of some flights cannot be fitted; "" if it can."""
    if not commands:
        return f"the logs have no {what}"
    change = max(float(np.ptp(command, axis=0).max()) for command in commands)
    return f"the {what} never change" if change < LEAST_CHANGE[what] else ""


def lag_problem(flights: Sequence[Followed], steady: Steady, **options: Any) -> Problem:
    """A lag, the first of the parameters, behind steady values (n, k); see ``solve_lag``."""

    def model(values: np.ndarray) -> np.ndarray:
        modeled = []
        for i, part in enumerate(flights):
            part = part._replace(command=partly(part.command, part.spline, values[-1]))
            modeled.append(part.simulated(values[0], steady(values, i, part)))
        return np.concatenate(modeled)

    measured = np.concatenate([part.measured for part in flights])
    blocks = half_seconds([part.time for part in flights])
    return Problem(model=model, measured=measured, blocks=blocks, **options)


def solve_lag(problem: Problem, rate: float) -> Estimate:
    """A lag, with commands that are held or, where the logs clearly show it, change between rows.

    Args:
        problem: of a model of the values of its parameters, a lag the first, and of ``BETWEEN``,
            which follows them.
        rate: Hz, of the slowest log.

    Returns:
        The estimate; ``BETWEEN`` is among its constants where the commands change between rows.
    """
    held, changing = solve_held(problem), solve_changing(problem)
    part, error = changing.constants[BETWEEN], changing.errors[BETWEEN]
    if np.isfinite(error) and part > CLEARLY * error:
        return changing
    name, period = problem.parameters[0].name, 1.0 / rate
    late = 0.5 * period * (min(part + 2.0 * error, 1.0) if np.isfinite(error) else 1.0)
    if not np.isfinite(held.errors[name]) or late <= problem.uncertain * held.constants[name]:
        return held
    line = (
        f"{name} ({held.group}) may be up to {late:.2g} s too short: the logs have a row every "
        f"{period:.2g} s and do not show whether commands change between rows; log faster"
    )
    return replace(held, warnings=(*held.warnings, line))


def solve_held(problem: Problem) -> Estimate:
    """A lag behind commands that are held until the next row; ``problem`` as of ``solve_lag``."""
    return solve(replace(problem, model=lambda at: problem.modeled(np.append(at, 0.0))))


def solve_changing(problem: Problem) -> Estimate:
    """A lag behind commands that change between the rows; ``problem`` as of ``solve_lag``."""
    between = Parameter(BETWEEN, 0.5, 0.0, 1.0, physical=True)
    fit = solve(replace(problem, parameters=[*problem.parameters, between]))
    lines = (line for line in fit.warnings if not line.startswith(f"{BETWEEN} ("))
    return replace(fit, warnings=tuple(lines))


def slowest(flights: Sequence[Followed]) -> float:
    """The lowest rate of some flights, Hz."""
    return min(part.rate for part in flights)


def fit_lag(
    parts: Sequence[Followed], group: str, tau: Parameter, what: str, lowest: float = -np.inf
) -> Estimate:
    """Fit one time constant, s, over the flights that have commands."""
    reason = never_follow([part.command for part in parts], what)
    if reason:
        return unknown(group, {tau.name: tau.base}, reason)
    problem = lag_problem(
        parts,
        lambda values, index, part: part.command,
        group=group,
        parameters=[tau],
        least_explained=lowest,
    )
    return solve_lag(problem, slowest(parts))
