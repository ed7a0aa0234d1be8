"""Describe a track, or write the file of a random one.

Prints the gates with the length of the leg to each, the slope of the leg and the turn at the gate.
With key=value settings, a random track is first written to the file TRACK. It depends only on the
settings.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, check_outputs, check_writable, parse
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Gate, Track

PRESET = "e2e_shac"  # whose rules check a track that has none of its own
PICTURES = (".png", ".svg", ".pdf")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    from quadjax.core.sections import describe
    from quadjax.race.random_track import RandomTrack

    keys = "\n".join(
        f"  {key.key:<10}{key.description} ({_shown(key.default)})" for key in describe(RandomTrack)
    )
    parser = Parser(
        "track",
        description=__doc__,
        epilog=f"Settings of a random track:\n{keys}\n\n"
        "Example: quadjax track mine.yaml seed=3 gates=12 turn_deg=90 --figure mine.png",
    )
    parser.add_argument("track", metavar="TRACK", help="track file, or the name of a shipped track")
    parser.add_argument(
        "settings", nargs="*", metavar="key=value", help="settings of a random track to write"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument("--figure", metavar="FILE.png", help="draw the track from two sides")
    options = parse(parser, argv)
    check_outputs(options, figure=PICTURES)
    if options.figure:
        _check_new(Path(options.figure), options.overwrite)
    return options


def _check_new(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already, allowed: another name, or --overwrite")


def _shown(default: object) -> str:
    return str(list(default) if isinstance(default, tuple) else default)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a track file if there are settings, then describe the track."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.plotting import save_figure
        from quadjax.evaluation.figures import trajectory_figure

    if options.settings:
        _write(Path(options.track), options.settings, options.overwrite)
    one = "evaluate.laps=1"  # all that a course has
    track = load_config(PRESET, [f"track.file={options.track}", one]).track
    print(describe_track(track))
    if options.figure:
        save_figure(trajectory_figure([], track.gates, track.name), options.figure)
        print(f"wrote {options.figure}")


def _write(path: Path, settings: Sequence[str], overwrite: bool) -> None:
    from quadjax.config.loading import generated
    from quadjax.core.files import write_text
    from quadjax.core.yaml_files import parse_overrides, to_yaml

    _check_new(path, overwrite)
    check_writable(path, (".yaml",))
    tree = generated({"track": {"generate": parse_overrides(settings)}}, "settings")
    gates = {"name": path.stem, "rules": tree["rules"], "gates": tree["track"]["gates"]}
    head = "# World NED: meters, z down; yaw in degrees; size: width and height in meters."
    write_text(path, f"# Random track: {' '.join(settings)}\n{head}\n{to_yaml(gates)}")
    print(f"wrote {path}")


def describe_track(track: "Track") -> str:
    """The gates of a track as a table, with its length."""
    import numpy as np

    places = np.array([gate.position for gate in track.gates])
    before = np.roll(places, 1, axis=0)
    if not track.closed and track.start is not None:
        before[0] = track.start.position
    legs = places - before
    length, flat = np.linalg.norm(legs, axis=1), np.linalg.norm(legs[:, :2], axis=1)
    heading = np.degrees(np.arctan2(legs[:, 1], legs[:, 0]))
    turn = np.mod(np.roll(heading, -1) - heading + 180.0, 360.0) - 180.0
    kind = "a lap" if track.closed else "a course"
    lines = [
        f"{track.name}: {len(places)} gates, {kind} of {length.sum():.1f} m between centers",
        f"{'gate':>4} {'north':>7} {'east':>7} {'height':>7} {'yaw':>7} {'leg':>7} {'slope':>7} "
        f"{'turn':>7}  opening",
        f"{'':>4} {'m':>7} {'m':>7} {'m':>7} {'deg':>7} {'m':>7} {'deg':>7} {'deg':>7}  m",
    ]
    for index, gate in enumerate(track.gates):
        x, y, z = gate.position
        slope = np.degrees(np.arctan2(-legs[index, 2], flat[index]))
        apart = flat[index] > 0.01 and np.roll(flat, -1)[index] > 0.01
        end = f"{round(turn[index]):>7}" if apart else f"{'-':>7}"  # of a leg straight up or down
        lines.append(
            f"{index + 1:>4} {x:>7.2f} {y:>7.2f} {-z:>7.2f} {round(gate.yaw_deg):>7} "
            f"{length[index]:>7.2f} {round(slope):>7} {end}  {_opening(gate)}"
        )
    return "\n".join(lines)


def _opening(gate: "Gate") -> str:
    """Size, shape and tilt of a gate."""
    width, height = gate.size
    size = f"{width:g} x {height:g}" if gate.shape == "rectangle" else f"{width:g} {gate.shape}"
    tilts = {"pitch": gate.pitch_deg, "roll": gate.roll_deg}
    return ", ".join([size, *(f"{name} {value:g} deg" for name, value in tilts.items() if value)])
