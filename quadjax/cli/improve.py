"""Improve a policy by its own flights: fly, refit the model from the logs, fine-tune, repeat.

CONFIG is the race in which the policy was trained. The flights are on the stand-in plant, of which
only the logs are read. A model that does not predict held-out flights better than the present one
is rejected. With --plants the same is done on several drawn plants, each time from the policy of
the file. FOLDER gets the logs, the model and the training of each round, policy.npz and table.txt.
The same command resumes after a stop. With --logs it reads real logs instead: it prints what they
change in the model and fine-tunes the policy, without flying.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import (
    Parser,
    add_code,
    add_config,
    laps,
    names_of,
    parse,
    runs,
    seed,
    whole,
)
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.studies.improve.run import Report, Setting

OF_FLIGHTS = (  # options that have no effect with --logs
    *("rounds", "flights", "laps", "check", "seed", "plant", "plant_seed", "plants", "reference"),
)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("improve", description=__doc__)
    add_config(parser)
    parser.add_argument("--policy", required=True, metavar="FILE.npz")
    parser.add_argument("--rounds", type=whole(1, 100), help="of flying and learning (3)")
    parser.add_argument("--flights", type=runs, help="in each round (2)")
    parser.add_argument("--laps", type=laps, help="of each flight (6)")
    parser.add_argument("--steps", type=whole(1, 10**9), help="of each fine-tuning (1000000)")
    parser.add_argument("--fit", metavar="FILE", help=f"{names_of('fit')} (improve)")
    add_code(parser)
    parser.add_argument("--logs", nargs="+", metavar="FILE", help="real logs, in place of flights")
    parser.add_argument("--plant", metavar="FILE", help=f"{names_of('plant')} (standin)")
    parser.add_argument("--plant-seed", type=seed, help="of the plant's constants")
    parser.add_argument(
        "--plants", type=whole(1, 1000), metavar="N", help="plants, with seeds from --plant-seed on"
    )
    parser.add_argument("--seed", type=seed, help="of batteries, gusts and sensors (0)")
    parser.add_argument(
        "--check",
        type=whole(0, 10_000),
        help="flights of the first and the last policy that nothing is learned from (10)",
    )
    parser.add_argument(
        "--reference",
        action="store_true",
        default=None,
        help="also fine-tune the first policy on the plant's own numbers, for comparison",
    )
    parser.add_argument("--output", type=Path, default=Path("runs/improve"), metavar="FOLDER")
    parser.add_argument("--overwrite", action="store_true", help="replace earlier results")
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Improve a policy and print the rounds."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.core.compilation_cache import enable_compilation_cache
        from quadjax.core.folders import claim, remove_files
        from quadjax.learners.devices import prepare_devices
        from quadjax.studies.improve import run

    setting = _setting(options)
    enable_compilation_cache()
    prepare_devices(setting.race.run.devices)
    run.check_setting(setting)
    status = Console(stderr=True).status("starting")
    try:
        with claim(options.output, run.KIND, run.FILES, options.overwrite), status:
            if options.overwrite:
                remove_files(options.output, run.FILES)
            run.start(setting, options.output)
            text = _run(setting, options.plants, options.output, status.update)
    except run.StoppedError:
        argv = sys.argv[2:] if arguments is None else arguments
        again = shlex.join(["quadjax", "improve", *(x for x in argv if x != "--overwrite")])
        print(f"Stopped and saved. Continue with: {again}")
        return INTERRUPTED
    print(text)
    return 0


def _setting(options: argparse.Namespace) -> "Setting":
    """What the command asks for."""
    from quadjax.config.loading import load_config
    from quadjax.fitting.config import load_fit_config
    from quadjax.fitting.flight_log import find_logs
    from quadjax.plant.config import load_plant_config
    from quadjax.studies.improve.run import Setting

    for name in OF_FLIGHTS:
        if options.logs and getattr(options, name) is not None:
            raise InputError(f"--logs and --{name.replace('_', '-')} exclude each other")
    if options.reference and options.check == 0:
        raise InputError("--reference needs flights to compare: --check of at least 1")
    fit, plant = load_fit_config(options.fit or "improve", allow_code=options.allow_code), None
    logs: tuple[Path, ...] = ()
    if options.logs:
        files = fit.logs.replace(files=tuple(options.logs))
        logs = tuple(find_logs(files, Path()))
    else:
        plant = load_plant_config(options.plant or "standin")
        if options.plant_seed is not None:
            plant = plant.replace(constants=plant.constants.replace(seed=options.plant_seed))
    names = ("rounds", "flights", "laps", "steps", "check", "seed", "reference")
    given = {name: getattr(options, name) for name in names}
    numbers = {name: value for name, value in given.items() if value is not None}
    race = load_config(options.config, options.overrides)
    return Setting(race, Path(options.policy), fit, plant, logs, **numbers)


def _run(setting: "Setting", plants: int | None, folder: Path, report: "Report") -> str:
    """The rounds on one plant or several, or the real logs, and the text of the result."""
    from quadjax.core.files import write_text
    from quadjax.studies.improve import check, run
    from quadjax.studies.improve.model import Model, constant_lines, error_lines
    from quadjax.studies.improve.rounds import rounds_table

    if setting.logs:
        found = run.learn(setting, folder, report)
        lines = [*constant_lines(Model.of(setting.race), found.model), "", *error_lines(found)]
        lines += ["", f"rejected: {found.refused}" if found.refused else "accepted; policy.npz"]
        text = "\n".join(lines)
    elif plants:
        text = check.plants_table(check.improve_plants(setting, folder, plants, report))
    else:
        rounds = run.improve(setting, folder, report)
        text = rounds_table(rounds, check.checked(setting, rounds, folder, report))
    write_text(folder / "table.txt", text + "\n")
    return text
