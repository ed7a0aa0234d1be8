"""Time the laps of a policy, next to the published ones of the same race and protocol, if any.

Evaluates sampled actions, as the paper does, and the mean action. The JSON file, the figures and
the animation show the sampled runs, or the deterministic ones with --deterministic. key=value
overrides change the race: another residual, other constants, another track.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.cli.arguments import (
    Parser,
    add_config,
    add_races,
    add_ranges,
    check_outputs,
    count,
    parse,
    positive,
)
from quadjax.cli.progress import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.evaluation.evaluation import Evaluation
    from quadjax.policy.file import Policy
    from quadjax.studies.race_flights import RaceFlights
    from quadjax.studies.robustness import Flights

PICTURES = (".png", ".svg", ".pdf")
FIGURES = {  # methods of an evaluation by the options that write their figures
    "figure": "plot",
    "figure_3d": "plot_3d",
    "signals": "plot_signals",
    "attitude": "plot_attitude",
}
NOT_STUDIES = (  # options that have no effect on the flights of --robustness and --random-tracks
    *("start", "deterministic", "fixed_point", "offsets", "states", "figure"),
    *("figure_3d", "signals", "attitude", "animation", "body"),
)
NOT_RANDOM_TRACKS = ("robustness", "runs", "seed", "gates")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("evaluate", description=__doc__)
    add_config(parser)
    parser.add_argument("--policy", required=True, metavar="FILE.npz", help="policy file")
    add_races(parser)
    parser.add_argument("--deterministic", action="store_true", help="mean actions only")
    parser.add_argument(
        "--fixed-point", action="store_true", help="use the arithmetic of the exported C"
    )
    parser.add_argument(
        "--body",
        type=positive,
        metavar="RADIUS",
        help="radius of the drone, m: gates, bounds and ground are closer by it, and gates are "
        "tested where the flight crosses their planes",
    )
    add_ranges(
        parser, "with --fixed-point: the ranges that the C was exported with, if not the default"
    )
    parser.add_argument(
        "--robustness",
        action="store_true",
        help="print crashes and median lap of 1000 flights of 12 s (or --runs, --seconds) from "
        "1 m before a gate, with all constants drawn from ±0, 10, 20 and 30%%",
    )
    parser.add_argument(
        "--from-start",
        action="store_true",
        help="with --robustness: whole races (--laps or --gates) from around the track's start, "
        "with their times and highest speed, also for the populations of the vehicle model",
    )
    parser.add_argument("--seconds", type=count, help="with --robustness: of a flight")
    parser.add_argument(
        "--random-tracks",
        type=count,
        metavar="N",
        help="print finished flights and laps of one flight from hover on each of N random tracks: "
        "those of randomization.tracks, with the seeds that follow",
    )
    parser.add_argument("--json", metavar="FILE.json", help="write the laps")
    parser.add_argument(
        "--offsets", action="store_true", help="print the distances from the gates' centers"
    )
    parser.add_argument("--states", metavar="FILE.npz|.csv", help="write all trajectories")
    parser.add_argument("--figure", metavar="FILE.png", help="draw the flight from two sides")
    parser.add_argument("--signals", metavar="FILE.png", help="draw actuators and rates over time")
    parser.add_argument("--figure-3d", metavar="FILE.png", help="draw the flight in perspective")
    parser.add_argument("--attitude", metavar="FILE.png", help="draw height and attitude over time")
    parser.add_argument("--animation", metavar="FILE.gif", help="animate the flight")
    arguments = parse(parser, argv)
    if arguments.seconds and not arguments.robustness:
        raise InputError("--seconds is allowed only with --robustness")
    if arguments.from_start and not arguments.robustness:
        raise InputError("--from-start is allowed only with --robustness")
    for option in ("robustness", "random_tracks"):
        if getattr(arguments, option):
            _refuse_others(arguments, option)
    if arguments.ranges and not arguments.fixed_point:
        raise InputError("--range is allowed only with --fixed-point")
    pictures = dict.fromkeys(FIGURES, PICTURES) | {"animation": (".gif",)}
    check_outputs(arguments, json=(), states=(".npz", ".csv"), **pictures)
    return arguments


def _refuse_others(arguments: argparse.Namespace, option: str) -> None:
    """Refuse options that have no effect with --robustness or --random-tracks."""
    if option == "random_tracks" and arguments.laps == 1:
        raise InputError("--laps is 1, allowed: at least 2 with --random-tracks")
    unused = NOT_STUDIES + (NOT_RANDOM_TRACKS if option == "random_tracks" else ("laps", "gates"))
    if arguments.from_start:
        unused, option = (*NOT_STUDIES, "seconds"), "from_start"
    for name in unused:
        if getattr(arguments, name) not in (None, False, "hover"):
            given, other = (each.replace("_", "-") for each in (name, option))
            raise InputError(f"--{given} is not allowed with --{other}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate a policy."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.race import race_of
        from quadjax.evaluation.evaluation import lap_table
        from quadjax.policy import pilot
        from quadjax.policy.file import Policy

    config = load_config(options.config, options.overrides)
    policy = Policy.load(options.policy, config)
    pilot.fit_race(*race_of(config), policy, options.policy)
    if options.robustness:
        return _robustness(config, policy, options, console)
    if options.random_tracks:
        return _random_tracks(config, policy, options, console)
    with steps(console) as report:
        report("compiling and simulating")
        evaluations = _evaluate_all(config, policy, options)
    print(lap_table(evaluations))
    _write(next(iter(evaluations.values())), options, console)
    return 0


def _robustness(
    config: "Config", policy: "Policy", options: argparse.Namespace, console: Console
) -> int:
    """Fly with randomized constants, print the table and write the numbers."""
    from quadjax.core.files import write_json
    from quadjax.core.provenance import provenance
    from quadjax.studies.race_flights import fly_races, race_table
    from quadjax.studies.robustness import fly_spreads, spread_table

    runs, seed, name = options.runs or 1000, options.seed, options.policy
    result: dict[str, object] = {}
    found: Sequence[Flights | RaceFlights]
    with steps(console) as report:
        report("compiling and simulating")
        if options.from_start:
            found = fly_races(policy, config, runs, options.laps, options.gates, seed, name)
            text = race_table(found)
        else:
            result["seconds"] = options.seconds or 12
            found = fly_spreads(policy, config, runs, options.seconds or 12, seed, name)
            text = spread_table(found, Path(name).stem)
    print(text)
    if options.json:
        result |= {"flights": [each.to_json() for each in found]}
        write_json(options.json, result | {"provenance": provenance(config, name, seed)})
        console.print(f"wrote {options.json}", highlight=False)
    return 0


def _random_tracks(
    config: "Config", policy: "Policy", options: argparse.Namespace, console: Console
) -> int:
    """Fly on random tracks, print the table and write the numbers."""
    from quadjax.core.files import write_json
    from quadjax.core.provenance import provenance
    from quadjax.race.random_track import RandomTracks
    from quadjax.studies.random_tracks import fly_random_tracks

    trained = config.randomization.tracks or RandomTracks()
    tracks = trained.replace(seed=trained.seed + trained.count, count=options.random_tracks)
    with steps(console) as report:
        report("compiling and simulating")
        found = fly_random_tracks(policy, config, tracks, options.laps or 3, options.policy)
    print(found.table())
    if options.json:
        origin = provenance(config, options.policy, options.seed)
        write_json(options.json, found.to_json() | {"provenance": origin})
        console.print(f"wrote {options.json}", highlight=False)
    return 0


def _evaluate_all(
    config: "Config", policy: "Policy", options: argparse.Namespace
) -> "dict[str, Evaluation]":
    """Every line of the table by its label; the first is the one to save."""
    from quadjax.config.race import race_of
    from quadjax.evaluation.evaluation import evaluate

    common = {
        "runs": options.runs,
        "laps": options.laps,
        "gates": options.gates,
        "start": options.start,
        "seed": options.seed,
        "name": options.policy,
        "body_radius": options.body,
    }
    if options.fixed_point:
        from quadjax.export.actor import fixed_point_fly
        from quadjax.export.race_tables import track_ranges
        from quadjax.export.ranges import parse_overrides

        _, params = race_of(config)
        ranges = track_ranges(policy.layout, params.track) | parse_overrides(options.ranges)
        actor = fixed_point_fly(policy, ranges)
        fixed = evaluate(policy, config, deterministic=True, actor=actor, **common)
        return {"fixed point, mean": fixed}
    evaluations = {}
    for deterministic in (True,) if options.deterministic else (False, True):
        each = evaluate(policy, config, deterministic=deterministic, **common)
        evaluations[each.label()] = each
    return evaluations


def _write(evaluation: "Evaluation", options: argparse.Namespace, console: Console) -> None:
    """Write the JSON file, the figures and the animation that were asked for."""
    import numpy as np

    from quadjax.core.files import write_json
    from quadjax.core.plotting import save_figure

    if options.offsets and evaluation.gate_offsets.size:
        mean, wide = evaluation.gate_offsets.mean(), np.percentile(evaluation.gate_offsets, 95.0)
        print(f"distance from the gates' centers: mean {mean:.3f} m, 95% within {wide:.3f} m")
    if options.json:
        write_json(options.json, evaluation.to_json())
    if options.states:
        evaluation.save_states(options.states)
    figures = {method: getattr(options, option) for option, method in FIGURES.items()}
    for method, path in figures.items():
        if path:
            save_figure(getattr(evaluation, method)(), path)
    if options.animation:
        from quadjax.evaluation.animation import frame_count
        from quadjax.training.progress import bar

        with bar(console=console) as progress:
            task = progress.add_task("animation", total=frame_count(evaluation.flights))
            evaluation.animate(options.animation, lambda: progress.advance(task))
    for path in (options.json, options.states, *figures.values(), options.animation):
        if path:
            console.print(f"wrote {path}", highlight=False)
