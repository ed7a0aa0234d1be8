"""Fly exported C on a simulated drone: software in the loop.

The C of DIR, a folder of quadjax export, is compiled for this machine and runs as a process of its
own. States go to it and commands come back over a socket. With --listen, your own autopilot
connects instead; DIR may then also be a preset or a YAML file, whose race is flown. The drone is
the stand-in plant, whose config key=value overrides change, or with --simulator the simulator that
policies are trained in, the only one for the models racing and a2rl. OUTPUT/NAME gets states.npz
(for quadjax view and quadjax report), sil.json, table.txt and message.h, the messages for C.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.cli.arguments import (
    Parser,
    add_output,
    add_overwrite,
    laps,
    name,
    names_of,
    parse,
    runs,
    seed,
)
from quadjax.cli.progress import steps
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.sil.run import Setting

STOPPING = b"\nstopping: the flight so far is saved; Ctrl-C again ends without saving\n"


def _probability(text: str) -> float:
    return _number(text, 0.0, 1.0, "a probability from 0 to 1")


def _seconds(text: str) -> float:
    return _number(text, 0.001, 3600.0, "seconds, 0.001 to 3600")


def _milliseconds(text: str) -> float:
    return _number(text, 0.0, 10_000.0, "milliseconds, 0 to 10000")


def _speed(text: str) -> float | None:
    return None if text == "max" else _number(text, 0.01, 1000.0, "max, or 0.01 to 1000")


def _number(text: str, low: float, high: float, allowed: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = low - 1.0
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r:.60}, expected {allowed}")
    return value


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not int(port[:9]) < 65536:
        raise argparse.ArgumentTypeError(
            f"{text!r:.60}, expected HOST:PORT with a port of 0 to 65535"
        )
    return host, int(port)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "sil", description=__doc__, epilog="Example: quadjax sil out/ --late 0.2 --delay 20"
    )
    parser.add_argument(
        "source",
        type=Path,
        metavar="DIR",
        help="folder of quadjax export; with --listen also a config",
    )
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="key=value", help="change keys of the plant"
    )
    parser.add_argument(
        "--listen",
        type=_address,
        metavar="HOST:PORT",
        help="wait there for your own autopilot, at most 120 s",
    )
    parser.add_argument(
        "--race",
        metavar="CONFIG",
        help="config of the race, if that of DIR names your own code (config.yaml of DIR)",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--plant", metavar="CONFIG", help=f"{names_of('plant')} (default: standin)")
    where.add_argument("--simulator", action="store_true", help="the simulator of the training")
    parser.add_argument(
        "--speed",
        type=_speed,
        metavar="X",
        help="times real time; max: wait for every command, as fast as possible (default: max)",
    )
    parser.add_argument("--laps", type=laps, help="laps of a run (default: evaluate.laps)")
    parser.add_argument("--runs", type=runs, default=1, help="number of runs (default: 1)")
    parser.add_argument("--seed", type=seed, default=0, help="of drones and faults (default: 0)")
    parser.add_argument(
        "--timeout", type=_seconds, default=5.0, metavar="S", help="without an answer (default: 5)"
    )
    _add_faults(parser)
    parser.add_argument("--view", action="store_true", help="show the flight in the browser")
    parser.add_argument("--name", type=name, default="sil", help="of the folder (default: sil)")
    add_output(parser)
    add_overwrite(parser, "flight")
    return parse(parser, argv)


def _add_faults(parser: argparse.ArgumentParser) -> None:
    faults = parser.add_argument_group("faults, of messages in either direction")
    faults.add_argument("--drop", type=_probability, default=0.0, metavar="P", help="dropped")
    faults.add_argument("--late", type=_probability, default=0.0, metavar="P", help="late")
    faults.add_argument(
        "--delay", type=_milliseconds, metavar="MS", help="of late messages (default: 20)"
    )
    faults.add_argument(
        "--damage", type=_probability, default=0.0, metavar="P", help="with one bit flipped"
    )
    faults.add_argument(
        "--nan",
        action="append",
        default=[],
        metavar="FIELD=P",
        help="a number of a state's field is NaN; may be repeated",
    )
    faults.add_argument(
        "--wrong-unit",
        action="append",
        default=[],
        metavar="FIELD=UNIT",
        help="of the states: attitude=deg, rates=deg/s, position=mm, velocity=cm/s, "
        "rotor_speed=rpm; may be repeated",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print the result, write the files."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.core.folders import results
        from quadjax.sil.fly import INTERRUPTED as STOPPED
        from quadjax.sil.run import FILES, STATES_FILE, fly_all

    setting, folder = _setting(options), options.output / options.name

    with (
        results(folder, "flight", FILES, options.overwrite) as new,
        interruptions(STOPPING) as stop,
        steps(console) as report,
    ):
        flown = fly_all(setting, stop, report)
        flown.write(new)
    print(flown.text())
    print(f"wrote {folder}/")
    last = flown.races[-1]
    if last.gone is not None:
        raise last.gone
    if options.view and len(last.recording.time):
        from quadjax.cli.view import main as view

        view([str(folder / STATES_FILE), "--output", str(folder / "flight.html"), "--open"])
    return INTERRUPTED if last.recording.crash == STOPPED else 0


def _setting(options: argparse.Namespace) -> "Setting":
    """What the options say.

    Raises:
        InputError: options that do not go together.
    """
    if options.listen is None and not options.source.is_dir():
        hint = "an autopilot of your own needs --listen HOST:PORT"
        raise InputError(f"{options.source}: no such folder of quadjax export; {hint}")
    from quadjax.plant.config import load_plant_config
    from quadjax.sil.faults import WRONG_UNITS, Faults, parse_nan
    from quadjax.sil.fly import Timing
    from quadjax.sil.run import Setting

    for unit in options.wrong_unit:
        if unit not in WRONG_UNITS:
            raise InputError(f"--wrong-unit {unit}, allowed: {', '.join(WRONG_UNITS)}")
    if options.race is not None and not options.source.is_dir():
        raise InputError(f"--race has no effect: {options.source} is a race itself")
    if options.delay is not None and not options.late:
        raise InputError("--delay has no effect without --late")
    if options.simulator and options.overrides:
        raise InputError(f"{options.overrides[0]} has no effect with --simulator")
    plant = None
    if not options.simulator:
        plant = load_plant_config(options.plant or "standin", options.overrides)
    faults = Faults(
        options.drop,
        options.late,
        (20.0 if options.delay is None else options.delay) / 1000.0,
        options.damage,
        parse_nan(options.nan),
        tuple(options.wrong_unit),
    )
    timing = Timing(options.speed, options.timeout)
    return Setting(
        options.source,
        plant,
        options.listen,
        options.laps,
        options.runs,
        options.seed,
        timing,
        faults,
        options.race,
    )
