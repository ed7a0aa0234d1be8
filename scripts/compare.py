"""E2E and INDI in the simulator and on the stand-in plant, beside the published flights.

Writes to RUNS/NAME/: table.txt, compare.json, config.yaml and figures. key=value words change the
plant's config. The ablation flies the policies that are in its folder and says how to train the
others.
"""

import argparse
import time
from pathlib import Path

from rich.console import Console

from quadjax.cli.arguments import Parser, count, parse, seed
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError, command_line
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.plant.plant_schema import load_plant_config
from quadjax.studies.comparison import Setting, contender
from quadjax.studies.comparison_run import PARTS, Wanted, run_comparison
from quadjax.training.progress import bar


def _arguments() -> argparse.Namespace:
    parser = Parser(description=__doc__)
    parser.add_argument("config", help="YAML file of configs/plant")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--e2e", default=str(PRETRAINED / "e2e.npz"), metavar="FILE.npz")
    parser.add_argument("--indi", default=str(PRETRAINED / "indi_shac.npz"), metavar="FILE.npz")
    parser.add_argument("--ablation", type=Path, default=PRETRAINED / "ablation", metavar="FOLDER")
    parser.add_argument("--race", default=str(CONFIGS / "e2e.yaml"), metavar="FILE")
    parser.add_argument("--laps", type=count, default=6)
    parser.add_argument("--runs", type=count, default=100, help="of which the first 5 are kept")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--parts", default=",".join(PARTS), help=f"some of {','.join(PARTS)}")
    parser.add_argument("--name", default="compare", help="of the folder")
    parser.add_argument("--runs-folder", type=Path, default=Path("runs"), metavar="FOLDER")
    return parse(parser)


@command_line
def main() -> int:
    """Compare."""
    arguments, console = _arguments(), Console(stderr=True)
    parts = tuple(arguments.parts.split(","))
    for part in parts:
        if part not in PARTS:
            raise InputError(f"--parts: {part!r}, allowed: {', '.join(PARTS)}")
    started = time.monotonic()
    setting = Setting(
        load_config(arguments.race),
        load_plant_config(arguments.config, arguments.words),
        arguments.laps,
        arguments.runs,
        arguments.seed,
    )
    contenders = (contender("E2E", arguments.e2e), contender("INDI", arguments.indi))
    for own, kind in zip(contenders, ("motor", "rate"), strict=True):
        if own.policy.vehicle != kind:
            raise InputError(f"{own.file}: a policy for the {own.policy.vehicle}, expected {kind}")
    wanted = Wanted(parts, arguments.ablation, arguments.runs_folder / arguments.name)
    with bar(counted=True, console=console) as progress:
        task = progress.add_task("compiling", total=wanted.steps())

        def report(line: str) -> None:
            progress.update(task, description=line, advance=1)
            if not console.is_terminal:
                console.print(f"{time.monotonic() - started:5.0f} s  {line}", highlight=False)

        text = run_comparison(setting, contenders, wanted, report)
    print(text)
    print(f"wrote {wanted.folder}/ in {time.monotonic() - started:.0f} s")
    return 0


if __name__ == "__main__":
    main()
