"""Compute the best known lap of a track and a lower bound of the lap time.

The best known lap is a local optimum, found by direct collocation from several initial guesses
and verified in the model. It is an upper bound of the shortest lap. The lower bound holds for every
flight that stays below --bound-speed. With --policy, the policy's fastest lap is compared with the
best known one, and is one of the initial guesses. Disturbances, randomization and model mismatch
of the config are ignored. key=value overrides change the race.
"""

import argparse
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from quadjax.cli.arguments import Parser, add_config, check_outputs, parse, whole
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.limits.bound import LowerBound
    from quadjax.limits.collocation import Trajectory
    from quadjax.limits.compare import Comparison
    from quadjax.limits.problem import Problem
    from quadjax.limits.solve import BestKnown

PICTURES = (".png", ".svg", ".pdf")
MOST_LAPS, MOST_SECONDS = 20, 86_400
SPLINE_SPEEDS = (4.0, 2.5, 6.0)  # m/s, of the initial guesses without a policy
RANDOM_SPREAD = 0.8  # fraction of the openings
POLICY_LAPS = 4
FASTER = 1.2  # default of --bound-speed, times the top speed of the best known lap


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("limit", description=__doc__)
    add_config(parser)
    parser.add_argument("--policy", metavar="FILE.npz", help="compare with this policy's lap")
    parser.add_argument(
        "--laps", type=whole(1, MOST_LAPS), help="laps of a flight from hover (default: 1)"
    )
    parser.add_argument(
        "--start",
        choices=("periodic", "hover"),
        default="periodic",
        help="a lap that ends in the state in which it starts, or laps from hover",
    )
    opening = parser.add_mutually_exclusive_group()
    opening.add_argument("--centers", action="store_true", help="through the gates' centers")
    opening.add_argument(
        "--clearance",
        type=_number(0.0),
        default=0.0,
        metavar="M",
        help="distance from the edges, m",
    )
    parser.add_argument(
        "--speed",
        type=_number(0.1),
        default=30.0,
        metavar="M/S",
        help="speed limit (default: 30)",
    )
    parser.add_argument(
        "--bound-speed",
        type=_number(0.1),
        metavar="M/S",
        help="the lower bound holds for flights below this speed (default: 1.2 times the top "
        "speed of the best known lap)",
    )
    parser.add_argument(
        "--starts",
        type=whole(1, 100),
        default=2,
        help="number of initial guesses in addition to the policy's laps (default: 2)",
    )
    parser.add_argument(
        "--seconds",
        type=whole(1, MOST_SECONDS),
        default=300,
        help="time limit of the search (default: 300)",
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the result")
    parser.add_argument("--npz", metavar="FILE.npz", help="write states and commands")
    parser.add_argument("--figure", metavar="FILE.png", help="draw path, speed and commands")
    arguments = parse(parser, argv)
    if arguments.laps is not None and arguments.start == "periodic" and arguments.laps > 1:
        raise InputError("--laps is allowed only with --start hover; a periodic lap is one lap")
    check_outputs(arguments, json=(".json",), npz=(".npz",), figure=PICTURES)
    return arguments


def _number(least: float) -> Callable[[str], float]:
    """A number from ``least`` to 1000, for ``type=``."""

    def read(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not least <= number <= 1000.0:
            raise argparse.ArgumentTypeError(f"{text!r}, expected a number, {least:g} to 1000")
        return number

    return read


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute the best known lap and the lower bound."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.limits.solve import Search

    config = _nominal(load_config(options.config, options.overrides))
    problem = _problem(config, options)
    with interruptions() as stop, console.status("compiling") as status:
        laps = _policy_laps(config, problem, options.policy) if options.policy is not None else []
        search = Search(problem, options.seconds, stop, lambda text: _show(status, stop, text))
        best = search.run(_guesses(problem, laps, options.starts))
        status.update("lower bound")
        bound = _bound(problem, best, options.bound_speed)
    flown = _compare(problem, best, laps)
    print(_summary(problem, best, bound, flown, options.policy))
    _write(config, problem, options, best, bound, flown, laps)
    for path in (options.json, options.npz, options.figure):
        if path:
            console.print(f"wrote {path}", highlight=False)
    return 0


def _show(status: Any, stop: threading.Event, text: str) -> None:
    status.update("stopping" if stop.is_set() else text)


def _nominal(config: "Config") -> "Config":
    """The config without disturbances, randomization and model mismatch."""
    from quadjax.config.schema import Disturbance

    vehicle = config.vehicle.replace(mismatch={})
    randomization = type(config.randomization)()
    return config.replace(
        vehicle=vehicle, disturbance=Disturbance(), randomization=randomization, schedules={}
    )


def _problem(config: "Config", options: argparse.Namespace) -> "Problem":
    from quadjax.config.race import race_of
    from quadjax.limits.problem import make_problem

    choices, params = race_of(config)
    if choices.rules:
        raise InputError("rules.extra: time-optimal laps do not support extra rules")
    return make_problem(
        choices.model,
        params,
        choices.gate_test == "world_box",
        laps=options.laps or 1,
        start=options.start,
        clearance=None if options.centers else options.clearance,
        speed_limit=options.speed,
    )


def _policy_laps(config: "Config", problem: "Problem", path: str) -> "list[Trajectory]":
    """Laps of a policy as trajectories, the fastest first."""
    import numpy as np

    from quadjax.config.race import race_of
    from quadjax.limits.guess import from_flight
    from quadjax.limits.solve import INTERVALS
    from quadjax.policy import pilot
    from quadjax.policy.file import Policy

    policy = Policy.load(path)
    laps = problem.laps if problem.start == "hover" else POLICY_LAPS
    result, trace = pilot.fly_policy(
        *race_of(config), policy, laps=laps, runs=1, deterministic=True, trace=True, name=path
    )
    assert trace is not None
    steps = round(float(result.seconds[0]) / config.rules.time_step)
    commands = np.asarray(trace.command, np.float64)[:steps, :, 0]
    found = from_flight(
        problem, commands, config.rules.time_step, config.vehicle.integrator, INTERVALS
    )
    if not found:
        raise InputError(f"{path}: no whole lap to compare ({result.crashes[0] or 'too few laps'})")
    return found


def _guesses(
    problem: "Problem", laps: "list[Trajectory]", starts: int
) -> "Iterator[tuple[str, Trajectory]]":
    """Initial guesses: the policy's fastest lap, splines, and random ones."""
    from quadjax.limits.guess import from_spline
    from quadjax.limits.solve import INTERVALS

    if laps:
        yield "policy's lap", laps[0]
    for index in range(starts):
        if index < len(SPLINE_SPEEDS) and index < 2:
            speed = SPLINE_SPEEDS[index]
            yield f"spline at {speed:g} m/s", from_spline(problem, INTERVALS, speed)
        else:
            speed = SPLINE_SPEEDS[index % len(SPLINE_SPEEDS)]
            guess = from_spline(problem, INTERVALS, speed, RANDOM_SPREAD, seed=index)
            yield f"random spline {index}", guess


def _bound(problem: "Problem", best: "BestKnown", speed: float | None) -> "LowerBound | str":
    """The lower bound, or why there is none."""
    from quadjax.limits.bound import lower_bound

    try:
        return lower_bound(problem, speed or FASTER * best.check.top_speed, best.total)
    except InputError as error:
        return str(error)


def _compare(
    problem: "Problem", best: "BestKnown", laps: "list[Trajectory]"
) -> "Comparison | None":
    from quadjax.limits.compare import compare

    return compare(problem, best.trajectory, laps[0]) if laps else None


def _summary(
    problem: "Problem",
    best: "BestKnown",
    bound: "LowerBound | str",
    flown: "Comparison | None",
    policy: str | None,
) -> str:
    lines = [
        f"best known: {best.total:.4f} s, top speed {best.check.top_speed:.1f} m/s, from the "
        f"{best.guess} ({best.seconds:.0f} s of computing)"
    ]
    if isinstance(bound, str):
        lines.append(f"lower bound: none ({bound})")
    else:
        width = 100.0 * (best.total - bound.time) / best.total
        lines.append(
            f"lower bound: {bound.time:.4f} s for flights below {bound.mass.speed:.1f} m/s; "
            f"the bracket is {width:.1f}% wide"
        )
    if flown is not None:
        lines.append(
            f"{policy}: {flown.flown.sum():.4f} s, {100 * flown.gap:.1f}% above best known"
        )
        lines.append(
            f"{'leg':>5} {'best known':>11} {'policy':>8} {'lost':>8} {'lost per meter':>15}"
        )
        rows = zip(flown.best, flown.flown, flown.lost_per_meter, strict=True)
        for leg, (ours, theirs, per_meter) in enumerate(rows, 1):
            lines.append(
                f"{leg:>5} {ours:>9.3f} s {theirs:>6.3f} s {theirs - ours:>6.3f} s "
                f"{1e3 * per_meter:>10.1f} ms/m"
            )
    return "\n".join([*lines, *(f"note: {note}" for note in best.notes)])


def _write(
    config: "Config",
    problem: "Problem",
    options: argparse.Namespace,
    best: "BestKnown",
    bound: "LowerBound | str",
    flown: "Comparison | None",
    laps: "list[Trajectory]",
) -> None:
    from quadjax.core.files import write_json, write_npz
    from quadjax.core.plotting import save_figure
    from quadjax.limits.compare import figure
    from quadjax.limits.report import arrays, to_json

    report = to_json(config, problem, best, bound, flown, options.policy)
    if options.json:
        write_json(options.json, report)
    if options.npz:
        write_npz(options.npz, arrays(problem, best), report)
    if options.figure:
        flights = {"best known": best.trajectory}
        if laps:
            flights["policy"] = laps[0]
        save_figure(figure(problem, flights), options.figure)
