"""Time the laps of a policy and print them next to the published ones.

Flies samples of the policy, as the paper does, and its mean. The JSON file, the figures and the
animation are of the samples, or of the mean with --deterministic. key=value overrides change the
race: another residual, other constants, another track.
"""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.cli.arguments import (
    Parser,
    add_config,
    add_races,
    add_ranges,
    check_writable,
    parse,
)
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.policy.file import Policy
    from quadjax.policy.pilot import Race
    from quadjax.race.laps import Laps, Trace

PICTURES = (".png", ".svg", ".pdf")


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("evaluate", description=__doc__)
    add_config(parser)
    parser.add_argument("--policy", required=True, metavar="FILE.npz", help="policy file")
    add_races(parser)
    parser.add_argument("--deterministic", action="store_true", help="fly the mean only")
    parser.add_argument(
        "--fixed-point", action="store_true", help="use the arithmetic of the exported C"
    )
    add_ranges(
        parser, "with --fixed-point: the ranges that the C was exported with, if not the default"
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the laps")
    parser.add_argument("--figure", metavar="FILE.png", help="draw the flight from above")
    parser.add_argument("--signals", metavar="FILE.png", help="draw actuators and rates over time")
    parser.add_argument("--animation", metavar="FILE.gif", help="animate the flight")
    arguments = parse(parser, words)
    if arguments.ranges and not arguments.fixed_point:
        raise InputError("--range is allowed only with --fixed-point")
    check_writable(arguments.json)
    check_writable(arguments.figure, PICTURES)
    check_writable(arguments.signals, PICTURES)
    check_writable(arguments.animation, (".gif",))
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate a policy."""
    words, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json
        from quadjax.evaluation import tables
        from quadjax.policy import pilot
        from quadjax.policy.file import read_policy
        from quadjax.training.paper import published_rows

    config = load_config(find_config(words.config), words.overrides)
    policy = read_policy(words.policy)
    pilot.check_fits(config, policy, words.policy)
    for key in pilot.unknown_scaling(policy):
        console.print(f"note: {words.policy}: observation.{key} is not used", highlight=False)
    race = pilot.Race(
        words.laps or config.evaluate.laps,
        words.runs or config.evaluate.runs,
        words.start == "hover",
        words.seed,
    )
    with console.status("compiling and flying"):
        flown = _fly_all(config, policy, race, words)
    rows = [tables.lap_row(label, laps) for label, (laps, _) in flown.items()]
    published = published_rows(config, race.laps, race.from_hover)
    print(tables.format_table(rows, published))
    for label, (laps, _) in flown.items():
        for line in tables.describe_crashes(laps).splitlines():
            print(f"{label}: {line}")
    laps, trace = next(iter(flown.values()))
    if words.json:
        write_json(words.json, laps.to_json())
        console.print(f"wrote {words.json}", highlight=False)
    if trace is not None:
        _draw(config, laps, trace, words, console)
    return 0


def _fly_all(
    config: "Config", policy: "Policy", race: "Race", words: argparse.Namespace
) -> "dict[str, tuple[Laps, Trace | None]]":
    """Every flight of the table by its label; the first is the one to save."""
    from quadjax.evaluation.tables import counted
    from quadjax.policy import pilot

    trace = any((words.figure, words.signals, words.animation))
    if words.fixed_point:
        from quadjax.export.pilot import fly_fixed_point
        from quadjax.export.ranges import parse_overrides

        ranges = parse_overrides(words.ranges)
        flown = fly_fixed_point(config, policy, race, trace, words.policy, ranges)
        return {"fixed point, mean action": flown}
    modes = {"deterministic": True}
    if not words.deterministic:
        modes = {f"sampled, {counted(race.runs, 'run')}": False} | modes
    return {
        label: pilot.fly_policy(config, policy, race, mean, trace, words.policy)
        for label, mean in modes.items()
    }


def _draw(
    config: "Config", laps: "Laps", trace: "Trace", words: argparse.Namespace, console: Console
) -> None:
    """Write the figures and the animation."""
    with loading():
        from quadjax.evaluation import figures
        from quadjax.evaluation.recording import choose, distinct, recordings

    flights = distinct(recordings(trace, laps, config.episode.dt))
    shown, gates = choose(flights), config.track.gates
    title = figures.flight_title(shown)
    if words.figure:
        figures.save_figure(figures.trajectory_figure([shown], gates, title), words.figure)
    if words.signals:
        figures.save_figure(figures.signals_figure(shown, title), words.signals)
    if words.animation:
        from quadjax.evaluation.animation import frame_count, write_animation
        from quadjax.training.progress import bar

        with bar(console=console) as progress:
            task = progress.add_task("animation", total=frame_count(flights))
            write_animation(flights, gates, words.animation, lambda: progress.advance(task))
    for path in (words.figure, words.signals, words.animation):
        if path:
            console.print(f"wrote {path}", highlight=False)
