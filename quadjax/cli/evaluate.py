"""Time the laps of a policy and print them next to the published ones.

Flies samples of the policy, as the paper does, and its mean. The JSON file, the figures and the
animation are of the samples, or of the mean with --deterministic. key=value overrides change the
race: another residual, other constants, another track.
"""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.core.arguments import (
    Parser,
    add_config,
    add_races,
    add_ranges,
    check_writable,
    parse,
)
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.evaluation.evaluation import Evaluation
    from quadjax.policy.file import Policy

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
    parser.add_argument(
        "--offsets", action="store_true", help="print the distances from the gates' centers"
    )
    parser.add_argument("--states", metavar="FILE.npz", help="write the trajectories of all runs")
    parser.add_argument("--figure", metavar="FILE.png", help="draw the flight from two sides")
    parser.add_argument("--signals", metavar="FILE.png", help="draw actuators and rates over time")
    parser.add_argument("--animation", metavar="FILE.gif", help="animate the flight")
    arguments = parse(parser, words)
    if arguments.ranges and not arguments.fixed_point:
        raise InputError("--range is allowed only with --fixed-point")
    check_writable(arguments.json)
    check_writable(arguments.states, (".npz",))
    check_writable(arguments.figure, PICTURES)
    check_writable(arguments.signals, PICTURES)
    check_writable(arguments.animation, (".gif",))
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate a policy."""
    words, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.evaluation.evaluation import lap_table
        from quadjax.policy import pilot
        from quadjax.policy.file import Policy
        from quadjax.training.compilation_cache import enable_compilation_cache

    config = load_config(words.config, words.overrides)
    policy = Policy.load(words.policy)
    pilot.check_fits(config, policy, words.policy)
    if config.run.compilation_cache:
        enable_compilation_cache()
    with console.status("compiling and flying"):
        flown = _fly_all(config, policy, words)
    print(lap_table(flown))
    _write(next(iter(flown.values())), words, console)
    return 0


def _fly_all(
    config: "Config", policy: "Policy", words: argparse.Namespace
) -> "dict[str, Evaluation]":
    """Every line of the table by its label; the first is the one to save."""
    from quadjax.evaluation import evaluation

    options = {
        "runs": words.runs,
        "laps": words.laps,
        "start": words.start,
        "seed": words.seed,
        "name": words.policy,
    }
    if words.fixed_point:
        from quadjax.export.actor import fly_fixed_point
        from quadjax.export.ranges import parse_overrides

        ranges = parse_overrides(words.ranges)
        fixed = evaluation.evaluate_by(
            lambda race, trace: fly_fixed_point(config, policy, race, trace, words.policy, ranges),
            config,
            deterministic=True,
            **options,
        )
        return {"fixed point, mean": fixed}
    flown = {}
    for deterministic in (True,) if words.deterministic else (False, True):
        each = evaluation.evaluate(policy, config, deterministic=deterministic, **options)
        flown[each.label()] = each
    return flown


def _write(flown: "Evaluation", words: argparse.Namespace, console: Console) -> None:
    """Write the JSON file, the figures and the animation that were asked for."""
    import numpy as np

    from quadjax.core.files import write_json
    from quadjax.core.plotting import save_figure

    if words.offsets and flown.gate_offsets.size:
        mean, wide = flown.gate_offsets.mean(), np.percentile(flown.gate_offsets, 95.0)
        print(f"distance from the gates' centers: mean {mean:.3f} m, 95% within {wide:.3f} m")
    if words.json:
        write_json(words.json, flown.to_json())
    if words.states:
        flown.save_states(words.states)
    if words.figure:
        save_figure(flown.plot(), words.figure)
    if words.signals:
        save_figure(flown.plot_signals(), words.signals)
    if words.animation:
        from quadjax.evaluation.animation import frame_count
        from quadjax.training.progress import bar

        with bar(console=console) as progress:
            task = progress.add_task("animation", total=frame_count(flown.flights))
            flown.animate(words.animation, lambda: progress.advance(task))
    for path in (words.json, words.states, words.figure, words.signals, words.animation):
        if path:
            console.print(f"wrote {path}", highlight=False)
