"""Compute the best known flight of a race and a lower bound of its time.

The best known flight is a local optimum, found by direct collocation from several initial guesses
and verified in the model. It is an upper bound of the shortest time. The lower bound holds for
every flight that stays below --bound-speed, up to rounding in float64. With --policy, the policy's
fastest lap is compared with the best known one, and is one of the initial guesses. Disturbances,
randomization and model mismatch of the config are ignored. key=value overrides change the race.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.cli.arguments import Parser, add_config, check_outputs, parse, whole
from quadjax.cli.progress import steps
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.limits.best_known import BestKnown, NotFoundError
    from quadjax.limits.bound import LowerBound
    from quadjax.limits.compare import Comparison
    from quadjax.limits.problem import Problem
    from quadjax.limits.run import Race
    from quadjax.limits.trajectory import Trajectory

STOPPING = b"\nstopping: the best flight so far is kept; Ctrl-C again ends without it\n"
PICTURES = (".png", ".svg", ".pdf")
MOST_LAPS, MOST_GATES, MOST_SECONDS = 20, 200, 86_400


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("limit", description=__doc__)
    add_config(parser)
    parser.add_argument("--policy", metavar="FILE.npz", help="compare with this policy's lap")
    parser.add_argument(
        "--guess",
        metavar="FILE.npz",
        action="append",
        help="start also from a flight that --npz wrote; may be given more than once",
    )
    _add_race(parser)
    parser.add_argument(
        "--bound-speed",
        type=_number(0.1),
        metavar="M/S",
        help="the lower bound holds for flights below this speed (default: 1.2 times the top "
        "speed of the best known flight, and at most the speed limit)",
    )
    parser.add_argument(
        "--starts",
        type=whole(1, 100),
        default=2,
        help="number of initial guesses in addition to the policy's lap (default: 2)",
    )
    parser.add_argument(
        "--seconds",
        type=whole(1, MOST_SECONDS),
        default=300,
        help="processor time of the search at most, summed over its threads; the lower bound takes "
        "up to a minute more (default: 300)",
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the result")
    parser.add_argument("--npz", metavar="FILE.npz", help="write states and commands")
    parser.add_argument("--figure", metavar="FILE.png", help="draw path, speed and commands")
    arguments = parse(parser, argv)
    check_outputs(arguments, json=(".json",), npz=(".npz",), figure=PICTURES)
    return arguments


def _add_race(parser: argparse.ArgumentParser) -> None:
    """The flight: its length, its end, how gates are passed, and limits."""
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--laps",
        type=whole(1, MOST_LAPS),
        help="laps from the start of timed laps, in place of a periodic lap",
    )
    length.add_argument(
        "--gates", type=whole(1, MOST_GATES), help="gates from the start of timed laps"
    )
    parser.add_argument(
        "--stop",
        action="store_true",
        help="end at rest in the center of the last gate; the flight begins at the start",
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
    opening.add_argument(
        "--waypoint",
        type=_number(0.001),
        metavar="M",
        help="pass within this distance of the gates' centers, in any direction",
    )
    parser.add_argument(
        "--speed",
        type=_number(0.1),
        metavar="M/S",
        help="speed limit (default: the vehicle's fitted_speed, or 60)",
    )
    parser.add_argument(
        "--rates",
        type=_number(0.01),
        nargs=3,
        metavar="RAD/S",
        help="limits of the body rates about x, y, z (default: rules.body_rate_limit)",
    )


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
    """Compute the best known flight and the lower bound."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.race import race_of
        from quadjax.limits import run
        from quadjax.limits.best_known import NotFoundError
        from quadjax.limits.compare import compare
        from quadjax.limits.report import read_guess, write_flight
        from quadjax.policy.file import Policy

    config = nominal(load_config(options.config, options.overrides))
    choices, params = race_of(config)
    problem = run.problem_of(choices, params, _race(options, config.vehicle.fitted_speed))
    laps: list[Trajectory] = []
    guesses = {path: read_guess(problem, path) for path in options.guess or ()}
    with interruptions(STOPPING) as stop, steps(console) as show:
        show("compiling")
        if options.policy is not None:
            policy = Policy.load(options.policy)
            laps = run.policy_laps(choices, params, problem, policy, options.policy)
            guesses["policy's lap"] = laps[0]
        try:
            best = run.search(
                problem,
                guesses,
                starts=options.starts,
                seconds=options.seconds,
                stop=stop,
                report=lambda text: show("stopping" if stop.is_set() else text),
            )
        except NotFoundError as error:
            return _not_found(error, options.npz)
        if options.npz:  # the lower bound may take a minute
            write_flight(options.npz, config.vehicle.model, config.track.gates, problem, best)
        show("lower bound")
        bound = run.bound_of(problem, best, options.bound_speed)
    flown = compare(problem, best.trajectory, laps[0]) if laps else None
    print(run.summary(best, bound, flown, options.policy))
    _write(config, problem, options, best, bound, flown, laps)
    for path in (options.json, options.npz, options.figure):
        if path:
            console.print(f"wrote {path}", highlight=False)
    return 0


def _not_found(error: "NotFoundError", path: str | None) -> int:
    """Say why, and write a solution that is not verified, for ``--guess``."""
    from quadjax.limits.report import write_unverified

    print(f"error: {error}", file=sys.stderr)
    if error.unverified is not None and path is not None:
        write_unverified(path, error.unverified)
        print(f"wrote {path}: not verified, only for --guess", file=sys.stderr)
    return 1


def _race(options: argparse.Namespace, fitted_speed: float | None) -> "Race":
    from quadjax.limits.run import Race

    return Race(
        gates=options.gates,
        laps=options.laps,
        stops=options.stop,
        waypoint=options.waypoint,
        clearance=None if options.centers else options.clearance,
        speed=options.speed,
        rates=None if options.rates is None else tuple(options.rates),
        fitted_speed=fitted_speed,
    )


def nominal(config: "Config") -> "Config":
    """The config without disturbances, randomization and model mismatch."""
    from quadjax.config.schema import Disturbance

    vehicle = config.vehicle.replace(mismatch={})
    randomization = type(config.randomization)()
    return config.replace(
        vehicle=vehicle, disturbance=Disturbance(), randomization=randomization, schedules={}
    )


def _write(
    config: "Config",
    problem: "Problem",
    options: argparse.Namespace,
    best: "BestKnown",
    bound: "LowerBound | str",
    flown: "Comparison | None",
    laps: "list[Trajectory]",
) -> None:
    from quadjax.core.files import write_json
    from quadjax.core.plotting import save_figure
    from quadjax.limits.compare import figure
    from quadjax.limits.report import to_json, write_flight

    report = to_json(config, problem, best, bound, flown, options.policy)
    if options.json:
        write_json(options.json, report)
    if options.npz:
        gates = config.track.gates
        write_flight(options.npz, config.vehicle.model, gates, problem, best, report)
    if options.figure:
        flights = {"best known": best.trajectory}
        if laps:
            flights["policy"] = laps[0]
        save_figure(figure(problem, flights), options.figure)
