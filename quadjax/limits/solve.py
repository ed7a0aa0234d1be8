"""The best of several solves: mesh refinement, verification, time limit."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from quadjax.limits.best_known import (
    SAME,
    Attempt,
    BestKnown,
    NotFoundError,
    Unverified,
    notes_on,
)
from quadjax.limits.collocation import SMOOTHNESS, Dynamics, Settings, solve
from quadjax.limits.ipopt import Effort
from quadjax.limits.point_mass import POINT_MASS
from quadjax.limits.problem import Problem
from quadjax.limits.tracking import refined
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.verify import Check, verify

FINEST, NODES = 80, 800  # intervals of a leg, and of all legs, at most
MARGIN = 1e-4  # m, first distance from the edges; more where the flown path drifts
WIDENINGS, WIDER = 4, 5e-4  # times that the margin is increased, and by how much at first, m
MOST_EXCESS = 1.2  # of a body rate over its limit, up to which the limit is lowered
RESERVE = 0.002  # of the commands' ranges, kept for the regulator where a flight is rejected
FIRM_RESERVE = 0.01  # where it leaves the solution by more than ``MISSED``
SMALL = 0.01  # m, violation that is removed before the mesh is refined
FIRST_SHARE = 0.4  # of the time that is left, for each of the stages
STAGES = (  # fraction of the mesh, smoothness in s, reserve of the commands
    (2, 1e-2, 0.02),
    (1, 1e-3, 0.005),
    (1, SMOOTHNESS, 0.0),
)
SCREENED = 0.7  # of the time: when less is left, no further guess has a first stage
SAME_START = 1e-4  # relative difference of the first stages' times of the same flight
MOST_ITERATIONS = 500
MISSED = 0.05  # m, by which a flown path may miss before the margin is widened


class Solved(NamedTuple):
    """What the solver returns."""

    flight: Trajectory
    converged: bool
    status: str


class Search:
    """Solves from initial guesses in turn and keeps the best verified result."""

    def __init__(
        self,
        problem: Problem,
        seconds: float = 300.0,
        stop: threading.Event | None = None,
        report: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Prepare a search.

        Args:
            problem: the flight.
            seconds: limit of the search's processor time.
            stop: if set, the search ends with the best so far.
            report: called with one line on the progress.
        """
        self.problem, self.report = problem, report
        self.began, self.seconds = time.process_time(), seconds
        self.stop = stop or threading.Event()
        self.dynamics = Dynamics(problem)
        self.attempts: list[Attempt] = []
        self.best: BestKnown | None = None
        self.last: Unverified | None = None  # solution that IPOPT found, whether verified or not
        self.settings = Settings(margin=MARGIN)

    @property
    def over(self) -> bool:
        """Whether the time is up, or a stop was requested."""
        return self.stop.is_set() or self._left() <= 0.0

    def _left(self) -> float:
        return self.seconds - (time.process_time() - self.began)

    def run(self, guesses: Iterable[tuple[str, Trajectory]]) -> BestKnown:
        """Solve from each initial guess until the time limit.

        Raises:
            NotFoundError: no guess led to a verified flight.
        """
        screened = []
        for name, guess in guesses:
            if self.over:
                break
            if name.startswith(POINT_MASS):
                self.settings = Settings(margin=MARGIN)
                screened.append((name, guess.intervals, self._stage(name, guess, STAGES[0], False)))
                if self._left() < SCREENED * self.seconds:
                    break
            else:
                self._attempt(name, guess)
        self._attempt_screened(screened)
        if self.best is None and self.last is not None:
            self._verify_last(self.last)
        if self.best is None:
            tried = "; ".join(f"{each.guess}: {each.status}" for each in self.attempts)
            raise NotFoundError(tried, self.last)
        seconds = time.process_time() - self.began
        best = dataclasses.replace(self.best, attempts=tuple(self.attempts), seconds=seconds)
        return dataclasses.replace(best, notes=notes_on(self.problem, best))

    def _verify_last(self, last: Unverified) -> None:
        """Keep the last solution if it is verified, else the reason why it is not."""
        check = verify(self.problem, last.trajectory)
        if not self._keep(last.guess, last.trajectory, check, np.inf):
            error = check.error or f"it misses an edge by {1e3 * check.drift:.1f} mm"
            self.last = dataclasses.replace(last, error=error)

    def _attempt_screened(self, screened: list[tuple[str, int, Solved]]) -> None:
        """Continue from the first stage of point masses' flights, the fastest first."""
        tried: dict[str, float] = {}
        screened.sort(key=lambda each: (not each[2].converged, each[2].flight.total))
        for name, intervals, first in screened:
            total = first.flight.total
            same = [x for x, other in tried.items() if abs(other - total) < SAME_START * total]
            if self.over:
                self.attempts.append(Attempt(name, None, "only the first stage"))
                continue
            if same and first.converged:
                self.attempts.append(Attempt(name, None, f"leads to that of {same[0]}"))
                continue
            tried[name] = total
            self._attempt(name, first.flight, intervals, first)

    def _solve(
        self, name: str, guess: Trajectory, share: float = 1.0, warm: bool = False
    ) -> Solved:
        """Solve in at most a share of the time that is left."""
        best = "" if self.best is None else f", best {self.best.total:.4f} s"
        text = f"{name}, {guess.intervals} intervals a leg{best}"
        solution = solve(
            self.problem,
            self.dynamics,
            guess,
            self.settings,
            Effort(
                share * self._left(),
                MOST_ITERATIONS,
                warm,
                self.stop,
                lambda value: self.report(f"{text}: {value:.4f} s"),
            ),
        )
        if solution.converged:
            self.last = Unverified(solution.trajectory, name, self.settings.reserve, "")
        return Solved(solution.trajectory, solution.converged, solution.status)

    def _attempt(
        self, name: str, guess: Trajectory, intervals: int = 0, stage: Solved | None = None
    ) -> None:
        self.settings = Settings(margin=MARGIN)
        if self.best is None and not name.startswith(POINT_MASS):  # an earlier flight counts, too
            self._keep(name, guess, verify(self.problem, guess), np.inf)
        first, converged, status = self._approach(name, guess, intervals or guess.intervals, stage)
        if converged and (self.best is None or first.total < self.best.total * (1.0 - 1e-5)):
            status = self._refine(name, first)
        elif not converged:
            self._keep(name, first, verify(self.problem, first), np.inf)
        self.attempts.append(Attempt(name, first.total if converged else None, status))

    def _approach(
        self, name: str, guess: Trajectory, intervals: int, stage: Solved | None
    ) -> Solved:
        """Solve for smooth flights with a reserve of the commands first, then for the fastest.

        If the last does not converge, the fastest that converged is the result. ``stage`` is the
        result of the first, if that is solved already.
        """
        found, warm, status = None, False, "no time"
        for index, settings in enumerate(STAGES):
            if self.over:
                break
            if index or stage is None:
                stage = self._stage(name, guess.resample(intervals), settings, warm)
            guess, warm, status = stage
            if warm:
                found = guess
            elif found is not None:
                break
        if found is None or found.intervals < intervals:
            return Solved(guess, False, status)
        return Solved(found, True, status)

    def _stage(
        self, name: str, guess: Trajectory, stage: tuple[int, float, float], warm: bool
    ) -> Solved:
        """One of ``STAGES``; its settings stay if it converges, or if none did before."""
        before, (divisor, smoothness, reserve) = self.settings, stage
        self.settings = dataclasses.replace(before, smoothness=smoothness, reserve=reserve)
        mesh = guess.resample(guess.intervals // divisor)
        solved = self._solve(name, mesh, FIRST_SHARE, warm)
        if warm and not solved.converged:
            self.settings = before
        return solved

    def _refine(self, name: str, trajectory: Trajectory) -> str:
        """Refine the mesh until the time converges and the flight is verified.

        A small violation is removed on the first mesh already: finer ones take longer.
        """
        widened, change = 0, np.inf
        check = verify(self.problem, trajectory, MISSED)
        self._keep(name, trajectory, check, change)
        finest = min(FINEST, max(trajectory.intervals, NODES // len(trajectory.leg_times)))
        refine = not 0.0 < check.drift < SMALL
        if not refine:
            self._widen(check, widened)
        while not self.over:
            self._limit(check)
            refine = refine and 2 * trajectory.intervals <= finest
            mesh = trajectory
            if refine:
                mesh = refined(self.problem, trajectory, 2 * trajectory.intervals)
            finer, converged, status = self._solve(name, mesh, warm=True)
            if not converged:
                self._keep(name, finer, verify(self.problem, finer), np.inf)
                return status
            if refine:
                change = abs(finer.total - trajectory.total) / finer.total
            trajectory = finer
            check = verify(self.problem, trajectory, MISSED)
            refine = change > SAME and 2 * trajectory.intervals <= finest
            if self._keep(name, trajectory, check, change):
                if not refine:
                    return "verified"
            elif not np.isfinite(check.drift) or widened == WIDENINGS:
                return f"rejected: {check.error or 'it misses a gate'}"
            if check.drift > 0.0 and not refine:
                self._widen(check, widened)
                widened += 1
        return f"no time (at last: {check.error or 'verified'})"

    def _widen(self, check: Check, widened: int) -> None:
        """More distance from the edges, or a reserve of the commands for the regulator."""
        margin, reserve = self.settings.margin, self.settings.reserve
        if check.error:
            reserve = max(2.0 * reserve, RESERVE if check.drift < MISSED else FIRM_RESERVE)
        else:
            margin += 1.2 * check.drift + WIDER * 4.0**widened
        self.settings = dataclasses.replace(self.settings, margin=margin, reserve=reserve)

    def _limit(self, check: Check) -> None:
        """Keep to sides of frames, and lower the limits of rates that the flight exceeds."""
        limit, current = self.problem.rate_limit, self.settings.rate_limit
        current = limit if current is None else current
        excess = check.rates / limit
        if check.feedback and np.all(excess < MOST_EXCESS):
            current = current / np.where(excess > 1.0, 1.001 * excess, 1.0)
        walls = self.settings.walls + check.walls
        self.settings = dataclasses.replace(self.settings, rate_limit=current, walls=walls)

    def _keep(self, name: str, trajectory: Trajectory, check: Check, change: float) -> bool:
        """Keep a verified flight if it is the best, and whether it is verified."""
        if check.drift > 0.0:
            return False
        margin = self.settings.margin
        found = BestKnown(trajectory, check, name, margin, change, (), 0.0, ())
        if (
            self.best is None
            or found.total < self.best.total
            or (found.guess == self.best.guess and np.isfinite(change))
        ):
            self.best = found
        return True
