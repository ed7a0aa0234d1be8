"""``quadjax limit``."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config as TrainingConfig
    from quadjax.limits.best_known import NotFoundError

STOPPING = b"\nstopping: the best flight so far is kept; Ctrl-C again ends without it\n"
FLIGHT = Group("The flight", sort_key=2)
SEARCH = Group("The search", sort_key=1)
MAX_LAPS, MAX_GATES, MAX_SECONDS = 20, 200, 86_400
MeterPerSecond = Annotated[float, Parameter(converter=opt.number(0.1, 1000.0), metavar="M/S")]
Meter = Annotated[float, Parameter(converter=opt.number(0.0, 1000.0), metavar="M")]
Radius = Annotated[float, Parameter(converter=opt.number(0.001, 1000.0), metavar="M")]
Rates = Annotated[
    tuple[float, float, float],
    Parameter(converter=opt.several(opt.number(0.01, 1000.0)).converter, metavar="RAD/S"),
]


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
    waypoint: Annotated[Radius | None, Parameter(group=FLIGHT)] = None,
    speed: Annotated[MeterPerSecond | None, Parameter(group=FLIGHT)] = None,
    rates: Annotated[Rates | None, Parameter(group=FLIGHT)] = None,
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

    Example: quadjax limit e2e_fastest track=figure8 --seconds 150 --npz lap.npz

    Args:
        policy: Compare with this policy's lap.
        guess: Start also from a flight that --npz wrote; may be repeated.
        bound_speed: The lower bound holds for flights below this speed (default: 1.2 times
            the top speed of the best known flight, and at most the speed limit).
        starts: Number of initial guesses in addition to the policy's lap.
        seconds: Processor time of the search at most, summed over its threads; the lower
            bound takes up to a minute more.
        laps: Laps from the start of timed laps, in place of a periodic lap.
        gates: Gates from the start of timed laps.
        stop: End at rest in the center of the last gate; the flight begins at the start.
        centers: Through the gates' centers.
        clearance: Distance from the gates' edges, m.
        waypoint: Pass within this distance of the gates' centers, in any direction.
        speed: Speed limit (default: the vehicle's fitted_speed, or 60).
        rates: Limits of the body rates about x, y, z (default: rules.body_rate_limit).
        json: Write the result.
        npz: Write states and commands.
        figure: Draw path, speed and commands.
    """
    _exclude(laps=laps, gates=gates)
    _exclude(centers=centers or None, clearance=clearance, waypoint=waypoint)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.race import race_of
        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.limits import run
        from quadjax.limits.best_known import NotFoundError
        from quadjax.limits.compare import compare
        from quadjax.limits.compare import figure as draw
        from quadjax.limits.report import read_guess, to_json, write_flight
        from quadjax.policy.file import Policy

    settings = nominal(load_config(config, overrides))
    choices, params = race_of(settings)
    race = run.Race(
        gates=gates,
        laps=laps,
        stops=stop,
        waypoint=waypoint,
        clearance=None if centers else clearance or 0.0,
        speed=speed,
        rates=rates,
        fitted_speed=settings.vehicle.fitted_speed,
    )
    problem = run.problem_of(choices, params, race)
    flown = []
    guesses = {str(path): read_guess(problem, path) for path in guess or ()}
    with interruptions(STOPPING) as stopped, steps() as show:

        def report(text: str) -> None:
            show("stopping" if stopped.is_set() else text)

        report("compiling")
        if policy is not None:
            flown = run.policy_laps(choices, params, problem, Policy.load(policy), str(policy))
            guesses["policy's lap"] = flown[0]
        search: dict[str, Any] = {"starts": starts, "seconds": seconds, "report": report}
        try:
            best = run.search(problem, guesses, stop=stopped, **search)
        except NotFoundError as error:
            return _not_found(error, npz)
        if npz is not None:  # the lower bound may take a minute
            write_flight(npz, settings.vehicle.model, settings.track.gates, problem, best)
        report("lower bound")
        bound = run.bound_of(problem, best, bound_speed)
    compared = compare(problem, best.trajectory, flown[0]) if flown else None
    name = None if policy is None else str(policy)
    print(run.summary(best, bound, compared, name))
    record = to_json(settings, problem, best, bound, compared, name)
    if json is not None:
        write_json(json, record)
    if npz is not None:
        write_flight(npz, settings.vehicle.model, settings.track.gates, problem, best, record)
    if figure is not None:
        flights = {"best known": best.trajectory, **({"policy": flown[0]} if flown else {})}
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
    if error.unverified is not None and path is not None:
        write_unverified(path, error.unverified)
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
