"""Time a policy's laps and print them beside the published ones.

Flies samples of the policy, as the paper does, and its mean; the JSON file, the figures and the
animation are of the samples, or of the mean with --deterministic. key=value words change the
config: another residual, other constants, another track.
"""

import argparse

from rich.console import Console

from quadjax.cli.arguments import Parser, check_writable, count_up_to, parse, seed
from quadjax.config.checks import MOST_LAPS, MOST_RUNS
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, command_line
from quadjax.core.files import write_json
from quadjax.evaluation import tables
from quadjax.evaluation.recording import choose, distinct, recordings
from quadjax.export.pilot import fly_fixed_point
from quadjax.export.ranges import add_range_option, parse_overrides
from quadjax.policy import pilot
from quadjax.policy.file import Policy, read_policy
from quadjax.race.laps import Laps, Trace
from quadjax.training.progress import bar

PICTURES = (".png", ".svg", ".pdf")


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__)
    parser.add_argument("config", help="YAML file, as for training")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--policy", required=True, metavar="FILE.npz", help="policy file")
    parser.add_argument(
        "--laps", type=count_up_to(MOST_LAPS), help="laps of a run (the config's, 6)"
    )
    parser.add_argument("--runs", type=count_up_to(MOST_RUNS), help="runs (the config's, 5)")
    parser.add_argument("--deterministic", action="store_true", help="fly the mean only")
    parser.add_argument("--start", choices=("hover", "random"), default="hover")
    parser.add_argument("--seed", type=seed, default=0, help="of noise, disturbances and starts")
    parser.add_argument(
        "--fixed-point", action="store_true", help="fly the exported fixed-point code's numbers"
    )
    add_range_option(
        parser, "with --fixed-point: the ranges that it was exported with, where not the default"
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the laps")
    parser.add_argument("--figure", metavar="FILE.png", help="draw the flight from above")
    parser.add_argument("--signals", metavar="FILE.png", help="draw propellers and rates over time")
    parser.add_argument("--animation", metavar="FILE.gif", help="animate the flight")
    arguments = parse(parser)
    if arguments.ranges and not arguments.fixed_point:
        raise InputError("--range is of --fixed-point, which is missing")
    check_writable(arguments.json)
    check_writable(arguments.figure, PICTURES)
    check_writable(arguments.signals, PICTURES)
    check_writable(arguments.animation, (".gif",))
    return arguments


def _fly_all(
    config: Config, policy: Policy, race: pilot.Race, arguments: argparse.Namespace
) -> dict[str, tuple[Laps, Trace | None]]:
    """Every flight of the table by its label; the first is the one to keep."""
    trace = any((arguments.figure, arguments.signals, arguments.animation))
    if arguments.fixed_point:
        ranges = parse_overrides(arguments.ranges)
        flown = fly_fixed_point(config, policy, race, trace, arguments.policy, ranges)
        return {"fixed point, mean action": flown}
    modes = {"deterministic": True} if arguments.deterministic else {}
    modes = modes or {f"sampled, {tables.counted(race.runs, 'run')}": False, "deterministic": True}
    return {
        label: pilot.fly_policy(config, policy, race, mean, trace, arguments.policy)
        for label, mean in modes.items()
    }


def _draw(
    config: Config, laps: Laps, trace: Trace, arguments: argparse.Namespace, console: Console
) -> None:
    from quadjax.evaluation.figures import (
        flight_title,
        save_figure,
        signals_figure,
        trajectory_figure,
    )

    flights = distinct(recordings(trace, laps, config.episode.dt))
    shown, gates = choose(flights), config.track.gates
    title = flight_title(shown)
    if arguments.figure:
        save_figure(trajectory_figure([shown], gates, title), arguments.figure)
        console.print(f"wrote {arguments.figure}", highlight=False)
    if arguments.signals:
        save_figure(signals_figure(shown, title), arguments.signals)
        console.print(f"wrote {arguments.signals}", highlight=False)
    if arguments.animation:
        from quadjax.evaluation.animation import frame_count, write_animation

        with bar(console=console) as progress:
            task = progress.add_task("animation", total=frame_count(flights))
            write_animation(flights, gates, arguments.animation, lambda: progress.advance(task))
        console.print(f"wrote {arguments.animation}", highlight=False)


@command_line
def main() -> int:
    """Evaluate a policy."""
    arguments, console = _arguments(), Console(stderr=True)
    config = load_config(arguments.config, arguments.words)
    policy = read_policy(arguments.policy)
    pilot.check_fits(config, policy, arguments.policy)
    for key in pilot.unknown_scaling(policy):
        console.print(f"note: {arguments.policy}: observation.{key} is not used", highlight=False)
    race = pilot.Race(
        arguments.laps or config.evaluate.laps,
        arguments.runs or config.evaluate.runs,
        arguments.start == "hover",
        arguments.seed,
    )
    with console.status("compiling and flying"):
        flown = _fly_all(config, policy, race, arguments)
    rows = [tables.lap_row(label, laps) for label, (laps, _) in flown.items()]
    published = tables.published_rows(config, race.laps, race.from_hover)
    print(tables.format_table(rows, published))
    for label, (laps, _) in flown.items():
        for line in tables.describe_crashes(laps).splitlines():
            print(f"{label}: {line}")
    laps, trace = next(iter(flown.values()))
    if arguments.json:
        write_json(arguments.json, laps.to_json())
        console.print(f"wrote {arguments.json}", highlight=False)
    if trace is not None:
        _draw(config, laps, trace, arguments, console)
    return 0


if __name__ == "__main__":
    main()
