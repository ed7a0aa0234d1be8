"""The best of several solves: stages, mesh refinement, verification, time limit."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from quadjax.limits.collocation import SMOOTHNESS_S, Dynamics, Settings, Solution, solve
from quadjax.limits.guess import from_spline
from quadjax.limits.problem import BELOW_RULE, Problem
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.verify import Check, verify

MAX_LEG_INTERVALS, MAX_INTERVALS = 80, 800  # intervals of a leg, and of all legs, at most
MESH_CHANGE = 1e-3  # relative change of the time below which the mesh is fine enough
FIRST_MARGIN_M = 1e-4  # first distance from the edges; more where the flight drifts
WIDENINGS, FIRST_WIDENING_M = 4, 5e-4  # how often and how far the margin is increased at first
RESERVE, FIRM_RESERVE = 0.002, 0.01  # of the commands, kept for the regulator of a rejected flight
SMALL_MISS_M = 0.01  # above it, a miss is removed before refinement
LARGE_MISS_M = 0.05  # a miss that needs FIRM_RESERVE
LARGEST_EXCESS = 1.2  # of a body rate, up to which its limit is lowered
STAGE_SHARE = 0.4  # of the time that is left, for each of the stages
STAGES = (  # divisor of the mesh, smoothness in s, reserve of the commands
    (2, 1e-2, 0.02),
    (1, 1e-3, 0.005),
    (1, SMOOTHNESS_S, 0.0),
)


@dataclasses.dataclass(frozen=True)
class BestKnown:
    """A verified flight. Its time is an upper bound of the shortest time; it may not be optimal."""

    trajectory: Trajectory
    check: Check  # the flight by the commands
    guess: str  # where the solver started
    mesh_change: float  # relative change of the time between the last two meshes
    attempts: Mapping[str, str] = dataclasses.field(default_factory=dict)  # by guess, its result
    seconds: float = 0.0  # wall-clock time of the search

    @property
    def total(self) -> float:
        """Time, s: the longer of the solution's and of the flight by its commands."""
        return max(self.trajectory.total, self.check.total)


class NotFoundError(Exception):
    """No initial guess led to a verified flight: one line that says what was tried."""

    def __init__(
        self, attempts: Mapping[str, str], flight: Trajectory | None = None, error: str = ""
    ) -> None:
        """Name the guesses that were tried, and the last unverified solution with its error."""
        self.flight, self.error = flight, error
        tried = "; ".join(f"{guess}: {status}" for guess, status in attempts.items()) or "no time"
        text = f"no flight was found ({tried}); try more time (--seconds)"
        if flight is not None:
            text += f"; a solution of {flight.total:.3f} s is not verified: {error}"
        super().__init__(text)


class Search:
    """Solves from initial guesses in turn and keeps the best verified result."""

    def __init__(
        self,
        problem: Problem,
        seconds: float = 300.0,
        stop: threading.Event | None = None,
        report: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Prepare a search; see ``quadjax.limits.result.best_known``."""
        self.problem, self.stop, self.report = problem, stop or threading.Event(), report
        self.began, self.seconds = time.monotonic(), seconds
        self.dynamics = Dynamics(problem)
        self.best: BestKnown | None = None
        self.rejected: tuple[Trajectory, str] | None = None  # the last, and why

    def run(self, guesses: Mapping[str, Trajectory] | None = None, starts: int = 1) -> BestKnown:
        """Solve from each guess by name, then from ``starts`` splines.

        Raises:
            NotFoundError: no guess led to a verified flight.
        """
        attempts: dict[str, str] = {}
        for name, guess in self._guesses(guesses or {}, starts):
            attempts[name] = self._attempt(name, guess)
        if self.best is None:
            raise NotFoundError(attempts, *self.rejected or ())
        seconds = time.monotonic() - self.began
        return dataclasses.replace(self.best, attempts=attempts, seconds=seconds)

    def _left(self) -> float:
        """Seconds that are left; none after a request to stop."""
        return 0.0 if self.stop.is_set() else self.seconds - (time.monotonic() - self.began)

    def _guesses(
        self, guesses: Mapping[str, Trajectory], starts: int
    ) -> Iterator[tuple[str, Trajectory]]:
        yield from guesses.items()
        for index in range(starts):
            if self._left() <= 0.0:
                return
            yield f"spline {index + 1}", from_spline(self.problem, index)

    def _attempt(self, name: str, guess: Trajectory) -> str:
        """Solve from one guess; a verified guess is a result, too."""
        if self.best is None and not name.startswith("spline"):
            self._keep(name, guess, np.inf)
        flight, settings = self._approach(name, guess)
        if flight is None:
            return "not converged"
        if self.best is not None and flight.total > self.best.total * (1.0 - 1e-5):
            return f"{flight.total:.4f} s, not faster"
        return f"{flight.total:.4f} s, {self._refine(name, flight, settings)}"

    def _approach(self, name: str, guess: Trajectory) -> tuple[Trajectory | None, Settings]:
        """Solve for smooth flights with a reserve of the commands first, then for the fastest.

        If the last stage does not converge, the fastest on the whole mesh that did is the result.
        """
        flight, used, warm, intervals = None, Settings(), False, guess.intervals
        for divisor, smoothness, reserve in STAGES:
            seconds = STAGE_SHARE * self._left()
            settings = Settings(
                FIRST_MARGIN_M, reserve, smoothness=smoothness, seconds=seconds, warm=warm
            )
            guess, warm, _ = self._solve(name, guess.resample(intervals // divisor), settings)
            if warm and divisor == 1:
                flight, used = guess, settings
            elif flight is not None:
                break
        return flight, used

    def _solve(self, name: str, mesh: Trajectory, settings: Settings) -> Solution:
        if self._left() <= 0.0:
            return Solution(mesh, False, "no time")
        best = "" if self.best is None else f", best {self.best.total:.4f} s"
        text = f"{name}, {mesh.intervals} intervals a leg{best}"
        self.report(text)
        report = lambda value: self.report(f"{text}: {value:.4f} s")  # noqa: E731
        return solve(self.problem, self.dynamics, mesh, settings, self.stop, report)

    def _refine(self, name: str, flight: Trajectory, settings: Settings) -> str:
        """Refine the mesh until the time converges and the flight is verified.

        A small miss is removed on the first mesh already: finer ones take longer.
        """
        widenings, change = 0, np.inf
        finest = min(
            MAX_LEG_INTERVALS, max(flight.intervals, MAX_INTERVALS // len(flight.leg_times))
        )
        check = self._keep(name, flight, change)
        while self._left() > 0.0:
            fine, mesh = change <= MESH_CHANGE or 2 * flight.intervals > finest, flight
            if fine and not check.error:
                return "verified"
            if check.error and (fine or 0.0 < check.miss < SMALL_MISS_M):
                if widenings == WIDENINGS:
                    break
                settings = _wider(settings, check, widenings)
                widenings += 1
            else:
                mesh = flight.resample(2 * flight.intervals, self.problem)
            settings = dataclasses.replace(settings, seconds=self._left(), warm=True)
            solution = self._solve(name, mesh, settings)
            if not solution.converged:
                self._keep(name, solution.trajectory, np.inf)
                return solution.status
            if mesh is not flight:
                change = abs(solution.trajectory.total / flight.total - 1.0)
            flight = solution.trajectory
            check = self._keep(name, flight, change)
        return check.error or "verified on a coarse mesh"

    def _keep(self, name: str, flight: Trajectory, change: float) -> Check:
        """Verify a flight, and keep it if it is the best."""
        check = verify(self.problem, flight)
        if check.error:
            self.rejected = flight, check.error
            return check
        result = BestKnown(flight, check, name, change)
        best = self.best
        refined = best is not None and best.guess == name and np.isfinite(change)
        if best is None or refined or result.total < best.total:
            self.best = result
        return check


def _wider(settings: Settings, check: Check, widenings: int) -> Settings:
    """More distance from the edges, slower turns, or a reserve of commands for the regulator."""
    margin, reserve, rate_share = settings.margin, settings.reserve, settings.rate_share
    excess = check.rate_share * BELOW_RULE  # of a body rate over its limit
    if 1.0 < excess < LARGEST_EXCESS:
        rate_share *= BELOW_RULE / excess
    elif check.miss == 0.0 or check.miss > SMALL_MISS_M:
        reserve = max(2.0 * reserve, RESERVE if check.miss < LARGE_MISS_M else FIRM_RESERVE)
    if check.miss > 0.0:
        margin += 1.2 * check.miss + FIRST_WIDENING_M * 4.0**widenings
    return dataclasses.replace(settings, margin=margin, reserve=reserve, rate_share=rate_share)
