"""Replay a flight log through a policy and a model.

Three parts: the laps of the log, by its positions and the gates of the track; the commands of a
policy in the logged states, in floats and in the fixed point of the exported C, next to the
logged ones; the error of a model that is integrated from the logged states over 0.1 to 1 s. The
model is that of --vehicle, or of the race that the policy was trained in. The policy's commands do
not act on the flight. DIR/NAME gets table.txt, replay.json and the figures trajectory, commands and
prediction as PDF, SVG and PNG.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import (
    Parser,
    add_code,
    add_output,
    add_overwrite,
    check_outputs,
    name,
    parse,
)
from quadjax.cli.progress import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "replay",
        description=__doc__,
        epilog="Example: quadjax replay logs/flight.csv --policy e2e --logs paparazzi "
        "--vehicle runs/my_drone/vehicle.yaml",
    )
    parser.add_argument("log", metavar="LOG", type=Path, help="a flight log")
    parser.add_argument("--policy", metavar="FILE.npz", help="policy file, or a shipped one's name")
    parser.add_argument(
        "--logs",
        metavar="FIT.yaml",
        help="fit config whose section logs describes the columns (default: plain columns)",
    )
    add_code(parser)
    parser.add_argument("--race", metavar="CONFIG", help="race of the policy (its file's)")
    parser.add_argument("--track", metavar="FILE", help="track that was flown (the race's)")
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file of the model (the race's)")
    parser.add_argument(
        "--residual",
        metavar="FILE.npz",
        help="residual file of that vehicle, or none (residual.npz next to the vehicle file)",
    )
    parser.add_argument(
        "--drive",
        choices=("commands", "speeds"),
        help="drive the model by logged commands or rotor speeds (commands if there are any)",
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers there as well")
    parser.add_argument("--name", type=name, default="replay", help="of the folder (replay)")
    add_output(parser)
    add_overwrite(parser, "replay")
    arguments = parse(parser, argv)
    if arguments.policy is None and arguments.vehicle is None:
        raise InputError("--policy or --vehicle is required (try --help)")
    if arguments.residual is not None and arguments.vehicle is None:
        raise InputError("--residual needs --vehicle")
    check_outputs(arguments, json=(".json",))
    return arguments


def _residual_of(vehicle: Path) -> str | None:
    """The residual that a fit wrote next to a vehicle file; None for none."""
    residual = vehicle.with_name("residual.npz")
    return str(residual) if vehicle.is_file() and residual.is_file() else None


def main(arguments: Sequence[str] | None = None) -> None:
    """Read, replay, print, write."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json, write_text
        from quadjax.core.folders import results
        from quadjax.core.provenance import provenance
        from quadjax.export.race_source import own_race
        from quadjax.fitting.config import LogsConfig, load_fit_config
        from quadjax.fitting.flight_log import read_log
        from quadjax.policy.file import Policy
        from quadjax.policy.race import race_of_policy
        from quadjax.studies.replay.run import FILES, numbers, replay, tables, write_figures

    policy = own = drone = None
    if options.policy is not None:
        policy = Policy.load(options.policy)
        found = race_of_policy(
            policy, options.policy, options.race, options.track, Console(stderr=True).out
        )
        own, drone = own_race(found[0], policy, found[1], str(options.policy)), found[0]
    if options.vehicle is not None:
        overrides = [f"vehicle={options.vehicle}"]
        residual = options.residual or _residual_of(Path(options.vehicle))
        overrides += [f"vehicle.residual={residual}"] if residual not in (None, "none") else []
        overrides += [f"track={options.track}"] if options.track else []
        drone = load_config(options.race or "e2e_fastest", overrides)
    assert drone is not None
    logs = LogsConfig()
    if options.logs:
        logs = load_fit_config(options.logs, allow_code=options.allow_code).logs
    track = drone.track if policy is None else found[0].track
    folder, console = options.output / options.name, Console(stderr=True)
    with results(folder, "replay", FILES, options.overwrite) as new, steps(console) as report:
        log = read_log(options.log, logs)
        result = replay(log, track, drone, own, policy, options.drive, report)
        report("figures")
        text, record = tables(result), numbers(result) | {"provenance": provenance(drone)}
        write_text(new / "table.txt", text + "\n")
        write_json(new / "replay.json", record)
        write_figures(result, new)
    if options.json:
        write_json(options.json, record)
    print(text)
    print(f"wrote {folder}/")
