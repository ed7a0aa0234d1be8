"""``quadjax replay``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.folders import results
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config


def replay(
    log: Annotated[opt.InputFile, Parameter(name="LOG")],
    /,
    *,
    policy: opt.PolicyFile | None = None,
    logs: opt.Logs = opt.PLAIN_LOGS,
    race: opt.Race = None,
    track: str | None = None,
    vehicle: opt.InputFile | None = None,
    residual: Annotated[str | None, Parameter(metavar="FILE.npz")] = None,
    drive: Literal["commands", "speeds"] | None = None,
    json: opt.JsonFile = None,
    name: opt.RunName = "replay",
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Replay a flight log through a policy and a model.

    Three parts: the laps of the log, by its positions and the gates of the track;
    the commands of a policy in the logged states, in floats and in the fixed point
    of the exported C, next to the logged ones; the error of a model that is
    integrated from the logged states over 0.1 to 1 s. The model is that of
    --vehicle, or of the race that the policy was trained in. The policy's commands
    do not act on the flight. DIR/NAME gets table.txt, replay.json and the figures
    trajectory, commands and prediction as PDF, SVG and PNG.

    Example: quadjax replay logs/flight.csv --policy e2e_residual --logs paparazzi
    --vehicle runs/my_drone/vehicle.yaml

    Args:
        log: A flight log.
        policy: Policy file, or a shipped one's name.
        race: Race of the policy (default: its file's).
        track: Track that was flown (default: the race's).
        vehicle: Vehicle file of the model (default: the race's).
        residual: Residual file of that vehicle, or none (default: residual.npz next to the
            vehicle file).
        drive: Drive the model by logged commands or rotor speeds (commands if there are any).
        json: Write the numbers there as well.
    """
    with loading():
        from quadjax.export.race_source import policy_race
        from quadjax.fitting.flight_log import read_log
        from quadjax.policy.file import Policy
        from quadjax.policy.race import race_of_policy, warn_of_other_race
        from quadjax.replay.replay import FILES
        from quadjax.replay.replay import replay as replay_log

    if vehicle is None:
        if policy is None:
            raise InputError("--policy or --vehicle is required (try --help)")
        opt.refuse("without --vehicle", residual=residual)
    network = flown = drone = None
    if policy is not None:
        network = Policy.load(policy, race)
        drone, origin = race_of_policy(network, policy, race, track)
        warn_of_other_race(network, drone, policy)
        flown = policy_race(drone, network, origin, str(policy))
    gates = drone and drone.track
    if vehicle is not None:
        drone = _drone_of(vehicle, residual, race, track)
    assert drone is not None
    columns, folder = logs.columns(), output / name
    with results(folder, "replay", FILES, overwrite) as new, steps() as report:
        flight = read_log(log, columns)
        report("compiling and replaying")
        parts = (gates or drone.track, drone, flown, network, drive, report)
        replayed = replay_log(flight, *parts)
        report("figures")
        replayed.write(new)
    if json is not None:
        write_json(json, replayed.numbers)
    print(replayed.table())
    wrote(f"{folder}/", json)


def _drone_of(vehicle: Path, residual: str | None, race: str | None, track: str | None) -> "Config":
    """The race with the drone of a vehicle file, and the residual that a fit wrote next to it."""
    from quadjax.config.loading import load_config, with_track

    fitted = vehicle.with_name("residual.npz")
    if residual is None and vehicle.is_file() and fitted.is_file():
        residual = str(fitted)
    changes = [f"vehicle={vehicle}"]
    changes += [f"vehicle.residual={residual}"] if residual not in (None, "none") else []
    config = load_config(race or "e2e +fastest", changes)
    return config if track is None else with_track(config, track)
