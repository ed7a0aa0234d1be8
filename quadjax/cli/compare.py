"""Compare E2E and INDI in the simulator and on the stand-in plant.

DIR/NAME gets table.txt, compare.json, config.yaml and figures. key=value overrides change the
plant's config. The ablation evaluates the policies that are in its folder, and prints how to train
those that are missing.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import (
    Parser,
    add_config,
    add_output,
    add_overwrite,
    laps,
    name,
    names_of,
    parse,
    runs,
    seed,
    whole,
)
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("compare", description=__doc__)
    add_config(parser, names_of("plant"))
    parser.add_argument(
        "--e2e",
        default=str(PRETRAINED / "e2e_nominal.npz"),
        metavar="FILE.npz",
        help="default: e2e_nominal, which like indi_shac is not fitted to the plant",
    )
    parser.add_argument("--indi", default=str(PRETRAINED / "indi_shac.npz"), metavar="FILE.npz")
    parser.add_argument("--ablation", type=Path, default=PRETRAINED / "ablation", metavar="FOLDER")
    parser.add_argument(
        "--race",
        default="e2e_shac",
        metavar="CONFIG",
        help="preset or YAML file, whose vehicle is the model on board (e2e_shac)",
    )
    parser.add_argument(
        "--plants",
        type=whole(1, 1000),
        default=10,
        help="drawn plants, which share --runs (10)",
    )
    parser.add_argument(
        "--conditions",
        nargs="+",
        metavar="NAME",
        help="of the part plants: some of its rows, such as 'all effects' 'charge 0.2' (all)",
    )
    parser.add_argument("--laps", type=laps, default=6, help="laps of a run (6)")
    parser.add_argument("--runs", type=runs, default=100, help="number of runs (100)")
    parser.add_argument("--sampled", action="store_true", help="fly with the noise of training")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--parts", nargs="+", metavar="PART", help="some of the parts (all)")
    parser.add_argument("--name", type=name, default="compare", help="of the folder (compare)")
    add_output(parser)
    add_overwrite(parser, "comparison")
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare."""
    options, started = _arguments(arguments), time.monotonic()
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.folders import results
        from quadjax.plant.config import load_plant_config
        from quadjax.studies.comparison import Setting, contender
        from quadjax.studies.comparison_run import FILES, PARTS, Wanted, run_comparison
        from quadjax.training.progress import bar

    parts = tuple(options.parts or PARTS)
    for part in parts:
        if part not in PARTS:
            raise InputError(f"--parts: {part!r}, allowed: {', '.join(PARTS)}")
    if options.conditions and "plants" not in parts:
        raise InputError("--conditions has no effect without the part plants (--parts)")
    if "plants" in parts and options.runs % options.plants:
        raise InputError(
            f"--runs is {options.runs}, allowed: multiples of --plants ({options.plants})"
        )
    known = Wanted.conditions
    for condition in options.conditions or ():
        if condition not in known:
            raise InputError(f"--conditions: {condition!r}, allowed: {', '.join(known)}")
    setting = Setting(
        load_config(options.race),
        load_plant_config(options.config, options.overrides),
        options.laps,
        options.runs,
        options.seed,
        options.plants,
        not options.sampled,
    )
    contenders = (contender("E2E", options.e2e), contender("INDI", options.indi))
    for own, kind in zip(contenders, ("motor", "rate"), strict=True):
        if own.policy.vehicle != kind:
            raise InputError(
                f"{own.file}: a policy for the {own.policy.vehicle} vehicle, expected {kind} for "
                f"--{own.name.lower()}"
            )
    only = tuple(options.conditions or known)
    folder, console = options.output / options.name, Console(stderr=True)
    claimed = results(folder, "comparison", FILES, options.overwrite)
    with claimed as new, bar(counted=True, console=console) as progress:
        wanted = Wanted(parts, options.ablation, new, only)
        task = progress.add_task("compiling", total=wanted.steps())

        def report(line: str) -> None:
            progress.update(task, description=line, advance=1)
            if not console.is_terminal:
                console.print(f"{time.monotonic() - started:5.0f} s  {line}", highlight=False)

        text = run_comparison(setting, contenders, wanted, report)
    print(text)
    print(f"wrote {folder}/ in {time.monotonic() - started:.0f} s")
    return 0
