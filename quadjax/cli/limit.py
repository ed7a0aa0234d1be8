"""``quadjax limit``."""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.files import write_json
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.limits.problem import FlightOptions
    from quadjax.limits.result import Result

STOPPING = b"\nstopping: the best flight so far is kept; Ctrl-C again ends without it\n"
FLIGHT = Group("The flight", sort_key=2)
SEARCH = Group("The search", sort_key=1)
MeterPerSecond = Annotated[float, opt.number(0.1, 1000.0, metavar="M/S")]
Meter = Annotated[float, opt.number(0.0, 1000.0, metavar="M")]


def limit(
    config: opt.ConfigName,
    /,
    *overrides: opt.Overrides,
    policy: Annotated[opt.PolicyFile | None, Parameter(group=SEARCH)] = None,
    guess: Annotated[tuple[opt.InputFile, ...], Parameter(group=SEARCH, show_default=False)] = (),
    starts: Annotated[int, opt.whole(1, 100, group=SEARCH)] = 2,
    seconds: Annotated[int, opt.whole(1, 86_400, group=SEARCH)] = 300,
    laps: Annotated[int | None, opt.whole(1, 20, group=FLIGHT)] = None,
    gates: Annotated[int | None, opt.whole(1, 200, group=FLIGHT)] = None,
    stop: Annotated[opt.Flag, Parameter(group=FLIGHT)] = False,
    centers: Annotated[opt.Flag, Parameter(group=FLIGHT)] = False,
    clearance: Annotated[Meter, Parameter(group=FLIGHT)] = 0.0,
    speed: Annotated[MeterPerSecond | None, Parameter(group=FLIGHT)] = None,
    json: opt.JsonFile = None,
    npz: opt.NpzFile = None,
) -> int:
    """Compute the best known flight of a race.

    It is a local optimum, found by direct collocation from several initial guesses
    and verified in the model: an upper bound of the shortest time. Disturbances,
    randomization and model mismatch of the config are ignored.

    Example: quadjax limit e2e +fastest track=figure8 --seconds 150 --npz lap.npz

    Args:
        policy: Start also from the fastest lap of this policy.
        guess: Start also from a flight that --npz wrote; may be repeated.
        starts: Number of initial guesses in addition to the policy's lap.
        seconds: Time of the search at most.
        laps: Laps from the start of timed laps, in place of a periodic lap.
        gates: Gates from the start of timed laps.
        stop: End at rest in the center of the last gate; the flight begins at the start.
        centers: Through the gates' centers.
        clearance: Distance from the gates' edges, m.
        speed: Speed limit (default: the vehicle's fitted_speed, or 60).
        npz: Write states and commands.
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.limits.problem import FlightOptions
        from quadjax.limits.result import save_unverified
        from quadjax.limits.search import NotFoundError

    opt.exclude(laps=laps, gates=gates)
    opt.exclude(centers=centers, clearance=clearance or None)
    race = load_config(config, overrides)
    flight = FlightOptions(gates, laps, stop, None if centers else clearance, speed)
    search = {"policy": policy, "guesses": guess, "starts": starts, "seconds": seconds}
    try:
        result = _search(race, flight, search)
    except NotFoundError as error:
        print(f"error: {error}", file=sys.stderr)
        if npz is not None and save_unverified(npz, error, race):
            wrote(f"{npz}: not verified, only for --guess")
        return 1
    print(result.table())
    if json is not None:
        write_json(json, result.to_json())
    if npz is not None:
        result.save(npz)
    wrote(json, npz)
    return 0


def _search(race: "Config", flight: "FlightOptions", search: Mapping[str, Any]) -> "Result":
    """The best known flight; Ctrl-C ends the search with the best so far."""
    from quadjax.limits.result import best_known

    with interruptions(STOPPING) as stopped, steps() as show:

        def report(text: str) -> None:
            show("stopping" if stopped.is_set() else text)

        return best_known(race, flight, stop=stopped, report=report, **search)
