"""One search from a config: the problem, its initial guesses, the policy's laps, the summary."""

import dataclasses
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from quadjax.core.errors import InputError
from quadjax.limits.guess import from_flight, from_point_mass
from quadjax.limits.problem import Problem, make_problem
from quadjax.limits.trajectory import Trajectory

if TYPE_CHECKING:
    from quadjax.limits.best_known import BestKnown
    from quadjax.limits.bound import LowerBound
    from quadjax.limits.compare import Comparison
    from quadjax.policy.file import Policy
    from quadjax.race.environment import Choices, RaceParams

SPEED = 60.0  # m/s
BELOW_RULE = 0.998  # of rules.speed_limit, at the nodes: between them a flight may be faster
INTERVALS = 20  # of a leg, on the first mesh
SPEEDS = (4.0, 8.0, 2.5, 6.0)  # m/s, of the splines that initial guesses start from
RANDOM_SPREAD = 0.8  # fraction of the openings
POLICY_LAPS = 4
RECORDED = "position", "velocity", "euler", "rates", "actuators", "command"  # of a policy's flight
FASTER = 1.2  # times the top speed of the best known flight: default of the bound's speed


@dataclasses.dataclass(frozen=True)
class Race:
    """What is flown, in place of a periodic lap.

    Attributes:
        gates: gates of a flight from the start; None: a periodic lap, or ``laps``.
        laps: laps of a flight from the start; None: a periodic lap, or ``gates``.
        stops: whether it ends at rest in the center of the last gate.
        waypoint: m, gates are passed within this distance of their centers, in any direction.
        clearance: m from the edges; None: through the centers.
        speed: m/s, the speed limit; None: ``fitted_speed``, or 60 where it is unknown.
        rates: rad/s, limits about x, y, z; None: those of the rules.
        fitted_speed: m/s, of the vehicle; None: unknown.
    """

    gates: int | None = None
    laps: int | None = None
    stops: bool = False
    waypoint: float | None = None
    clearance: float | None = 0.0
    speed: float | None = None
    rates: tuple[float, float, float] | None = None
    fitted_speed: float | None = None

    @property
    def from_start(self) -> bool:
        """Whether the flight begins at rest."""
        return self.gates is not None or self.laps is not None or self.stops


def problem_of(choices: "Choices", params: "RaceParams", race: Race) -> Problem:
    """The flight of a race.

    Raises:
        InputError: a gate that cannot be passed, or rules that are not supported.
    """
    if choices.rules:
        raise InputError("rules.extra: time-optimal laps do not support extra rules")
    if params.battery is not None:
        raise InputError("battery: time-optimal laps do not support it, allowed: null")
    passages = race.gates
    if race.laps is not None:
        passages = race.laps * len(np.asarray(params.track.yaw))
    rule = np.inf if params.limits.speed is None else float(params.limits.speed)
    options = {} if race.rates is None else {"rate_limit": np.array(race.rates)}
    return make_problem(
        choices.model,
        params,
        choices.gate_test == "world_box",
        passages=passages,
        waypoint=race.waypoint,
        start="hover" if race.from_start else "periodic",
        stops=race.stops,
        clearance=race.clearance,
        speed_limit=min(race.speed or race.fitted_speed or SPEED, BELOW_RULE * rule),
        speed_rule=rule,
        fitted_speed=race.fitted_speed or np.inf,
        **options,
    )


def policy_laps(
    choices: "Choices", params: "RaceParams", problem: Problem, policy: "Policy", name: str
) -> list[Trajectory]:
    """Laps of a policy as trajectories, the fastest first.

    Raises:
        InputError: the policy completes no lap.
    """
    from quadjax.policy import pilot

    laps = POLICY_LAPS
    if problem.start == "hover":
        laps = -(-problem.passages // problem.gate_count)
    result, trace = pilot.fly_policy(
        choices, params, policy, laps=laps, runs=1, deterministic=True, trace=True, name=name
    )
    assert trace is not None
    time_step = float(params.limits.time_step)
    steps = round(float(result.seconds[0]) / time_step)
    columns = (np.asarray(getattr(trace, x), np.float64)[:steps, :, 0] for x in RECORDED)
    *motion, actuators, commands = columns
    found = from_flight(problem, tuple(motion), actuators, commands, time_step, INTERVALS)
    if not found:
        raise InputError(f"{name}: no whole lap to compare ({result.crashes[0] or 'too few laps'})")
    return found


def guesses(
    problem: Problem,
    given: dict[str, Trajectory],
    starts: int,
    stop: threading.Event,
    seconds: float = 60.0,
) -> Iterator[tuple[str, Trajectory]]:
    """Initial guesses by name: those given, then flights of a point mass.

    The first of these starts from a spline through the centers, nose as of ``from_point_mass``; the
    second has the nose along the velocity; others start from random points of the openings.
    """
    from quadjax.limits.point_mass import POINT_MASS

    yield from given.items()
    for index in range(starts):
        if stop.is_set():
            return
        guess = from_point_mass(
            problem,
            INTERVALS,
            SPEEDS[index % len(SPEEDS)],
            heading=index % 2 == 1,
            spread=RANDOM_SPREAD if index >= 2 else 0.0,
            seed=index,
            seconds=min(seconds, 60.0),
            stop=stop,
        )
        yield f"{POINT_MASS} {index + 1}", guess


def search(
    problem: Problem,
    given: dict[str, Trajectory],
    *,
    starts: int,
    seconds: float,
    stop: threading.Event,
    report: Callable[[str], object] = lambda text: None,
) -> "BestKnown":
    """The best of several solves; see ``quadjax.limits.solve.Search``.

    Raises:
        NotFoundError: no guess led to a verified flight.
    """
    from quadjax.limits.solve import Search

    return Search(problem, seconds, stop, report).run(
        guesses(problem, given, starts, stop, 0.3 * seconds)
    )


def bound_of(problem: Problem, best: "BestKnown", speed: float | None) -> "LowerBound | str":
    """The lower bound of flights below a speed, m/s, or why there is none."""
    from quadjax.limits.bound import lower_bound

    top = best.check.top_speed
    try:
        return lower_bound(
            problem, speed or max(top, min(FASTER * top, problem.speed_limit)), best.total
        )
    except InputError as error:
        return str(error)


def summary(
    best: "BestKnown", bound: "LowerBound | str", flown: "Comparison | None", policy: str | None
) -> str:
    """The result in a few lines of text."""
    lines = [
        f"best known: {best.total:.4f} s, top speed {best.check.top_speed:.1f} m/s, from the "
        f"{best.guess} ({best.seconds:.0f} s of computing)"
    ]
    if isinstance(bound, str):
        lines.append(f"lower bound: none ({bound})")
    else:
        width = 100.0 * (best.total - bound.time) / best.total
        lines.append(
            f"lower bound: {bound.time:.4f} s, up to rounding, for flights below "
            f"{bound.mass.speed:.1f} m/s; the bracket is {width:.1f}% wide"
        )
    if flown is not None:
        lines += [
            f"{policy}: {flown.flown.sum():.4f} s, {100 * flown.gap:.1f}% above best known",
            f"{'leg':>5} {'best known':>11} {'policy':>8} {'lost':>8} {'lost per meter':>15}",
        ]
        rows = zip(flown.best, flown.flown, flown.lost_per_meter, strict=True)
        lines += [
            f"{leg:>5} {ours:>9.3f} s {theirs:>6.3f} s {theirs - ours:>6.3f} s "
            f"{1e3 * per_meter:>10.1f} ms/m"
            for leg, (ours, theirs, per_meter) in enumerate(rows, 1)
        ]
    return "\n".join([*lines, *(f"note: {note}" for note in best.notes)])
