"""``quadjax limit``."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config as TrainingConfig
    from quadjax.limits.search import NotFoundError

STOPPING = b"\nstopping: the best flight so far is kept; Ctrl-C again ends without it\n"
FLIGHT = Group("The flight", sort_key=2)
SEARCH = Group("The search", sort_key=1)
MAX_LAPS, MAX_GATES, MAX_SECONDS = 20, 200, 86_400
FASTER = 1.2  # times the top speed of the best known flight: default of the bound's speed
MeterPerSecond = Annotated[float, Parameter(converter=opt.number(0.1, 1000.0), metavar="M/S")]
Meter = Annotated[float, Parameter(converter=opt.number(0.0, 1000.0), metavar="M")]


def limit(
    config: opt.Config,
    /,
    *overrides: opt.Overrides,
    policy: Annotated[opt.PolicyFile | None, Parameter(group=SEARCH)] = None,
    guess: Annotated[list[opt.InputFile] | None, Parameter(group=SEARCH)] = None,
    bound_speed: Annotated[MeterPerSecond | None, Parameter(group=SEARCH)] = None,
    starts: Annotated[int, Parameter(converter=opt.whole(1, 100), group=SEARCH)] = 2,
    seconds: Annotated[int, Parameter(converter=opt.whole(1, MAX_SECONDS), group=SEARCH)] = 300,
    laps: Annotated[int | None, Parameter(converter=opt.whole(1, MAX_LAPS), group=FLIGHT)] = None,
    gates: Annotated[int | None, Parameter(converter=opt.whole(1, MAX_GATES), group=FLIGHT)] = None,
    stop: Annotated[opt.Flag, Parameter(group=FLIGHT)] = False,
    centers: Annotated[opt.Flag, Parameter(group=FLIGHT)] = False,
    clearance: Annotated[Meter | None, Parameter(group=FLIGHT)] = None,
    speed: Annotated[MeterPerSecond | None, Parameter(group=FLIGHT)] = None,
    json: opt.JsonFile = None,
    npz: opt.NpzFile = None,
    figure: opt.Picture = None,
) -> int:
    """Compute the best known flight of a race and a lower bound of its time.

    The best known flight is a local optimum, found by direct collocation from
    several initial guesses and verified in the model. It is an upper bound of the
    shortest time. The lower bound holds for every flight that stays below
    --bound-speed, up to rounding in float64. With --policy, the policy's fastest
    lap is compared with the best known one, and is one of the initial guesses.
    Disturbances, randomization and model mismatch of the config are ignored.

    Example: quadjax limit e2e +fastest track=figure8 --seconds 150 --npz lap.npz

    Args:
        policy: Compare with this policy's lap.
        guess: Start also from a flight that --npz wrote; may be repeated.
        bound_speed: The lower bound holds for flights below this speed (default: 1.2 times
            the top speed of the best known flight, and at most the speed limit).
        starts: Number of initial guesses in addition to the policy's lap.
        seconds: Time of the search at most; the lower bound takes up to a minute more.
        laps: Laps from the start of timed laps, in place of a periodic lap.
        gates: Gates from the start of timed laps.
        stop: End at rest in the center of the last gate; the flight begins at the start.
        centers: Through the gates' centers.
        clearance: Distance from the gates' edges, m.
        speed: Speed limit (default: the vehicle's fitted_speed, or 60).
        npz: Write states and commands.
        figure: Draw path, speed and commands.
    """
    _exclude(laps=laps, gates=gates)
    _exclude(centers=centers or None, clearance=clearance)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.race import race_of
        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.limits.bound import lower_bound
        from quadjax.limits.compare import figure as draw
        from quadjax.limits.guess import policy_laps
        from quadjax.limits.problem import Flight, make_problem
        from quadjax.limits.report import read_guess, summary, to_json, write_flight
        from quadjax.limits.search import NotFoundError, Search
        from quadjax.policy.file import Policy

    settings = nominal(load_config(config, overrides))
    choices, params = race_of(settings)
    flight = Flight(
        gates=gates,
        laps=laps,
        stops=stop,
        clearance=None if centers else clearance or 0.0,
        speed=speed,
        fitted_speed=settings.vehicle.fitted_speed,
    )
    problem = make_problem(choices, params, flight)
    flown = None
    guesses = {str(path): read_guess(problem, str(path)) for path in guess or ()}
    with interruptions(STOPPING) as stopped, steps() as show:

        def report(text: str) -> None:
            show("stopping" if stopped.is_set() else text)

        report("compiling")
        if policy is not None:
            flown, *_ = policy_laps(problem, choices, params, Policy.load(policy), str(policy))
            guesses["policy's lap"] = flown
        try:
            best = Search(problem, seconds, stopped, report).run(guesses, starts)
        except NotFoundError as error:
            return _not_found(error, npz)
        if npz is not None:  # the lower bound may take a minute
            write_flight(npz, settings, problem, best, {})
        report("lower bound")
        top = best.check.top_speed
        fastest = bound_speed or max(top, min(FASTER * top, problem.speed_limit))
        bound = lower_bound(problem, fastest, best.total)
    name = None if policy is None else str(policy)
    print(summary(problem, best, bound, flown, name))
    record = to_json(settings, problem, best, bound, flown, name)
    if json is not None:
        write_json(json, record)
    if npz is not None:
        write_flight(npz, settings, problem, best, record)
    if figure is not None:
        flights = {"best known": best.trajectory, **({} if flown is None else {"policy": flown})}
        save_figure(draw(problem, flights), figure)
    wrote(json, npz, figure)
    return 0


def _exclude(**options: object) -> None:
    """Refuse more than one of some options."""
    names = [f"--{name}" for name, value in options.items() if value is not None]
    if len(names) > 1:
        raise InputError(f"{' and '.join(names)} exclude each other")


def _not_found(error: "NotFoundError", path: Path | None) -> int:
    """Say why, and write a solution that is not verified, for ``--guess``."""
    from quadjax.limits.report import write_unverified

    print(f"error: {error}", file=sys.stderr)
    if path is not None and write_unverified(path, error):
        print(f"wrote {path}: not verified, only for --guess", file=sys.stderr)
    return 1


def nominal(config: "TrainingConfig") -> "TrainingConfig":
    """The config without disturbances, randomization and model mismatch."""
    from quadjax.config.schema import Disturbance

    vehicle = config.vehicle.replace(mismatch={})
    randomization = type(config.randomization)()
    return config.replace(
        vehicle=vehicle, disturbance=Disturbance(), randomization=randomization, schedules={}
    )
