"""Train configs over several seeds, one after the other, and print the results.

A finished run of the same config is not trained again. The first table has the training runs;
'last' and 'best' are lap times of the flights that run.score selects. The second table has flights
of the best policies, as in 'quadjax results'. The figure shows the learning curves of all configs.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import (
    Parser,
    add_name,
    add_output,
    check_writable,
    is_override,
    parse,
    seed,
)
from quadjax.cli.arguments import (
    runs as run_count,
)
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("seeds", description=__doc__)
    parser.add_argument(
        "configs",
        nargs="+",
        metavar="CONFIG|key=value",
        help="presets or YAML files, and overrides for all of them",
    )
    parser.add_argument(
        "--seeds", type=seed, nargs="+", default=[0, 1, 2, 3, 4], help="(default: 0 1 2 3 4)"
    )
    parser.add_argument("--runs", type=run_count, default=100, help="flights of each kind (100)")
    add_name(parser)
    add_output(parser)
    parser.add_argument("--figure", metavar="FILE", help="default: DIR/NAMES_seeds.png")
    parser.add_argument(
        "--overwrite", action="store_true", help="remove earlier runs of the same names first"
    )
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, draw, evaluate and tabulate."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.stored import names_of_code
        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.core.provenance import provenance
        from quadjax.evaluation.curves import learning_figure
        from quadjax.evaluation.seeds import evaluate_seed, format_seeds

    named = [f"name={options.name}"] if options.name else []
    configs, overrides = configs_of([*options.configs, *named])
    runs, seeds = options.output, list(dict.fromkeys(options.seeds))
    figure = Path(options.figure or runs / f"{'_and_'.join(configs)}_seeds.png")
    check_writable(options.figure, (".png", ".svg", ".pdf"))
    groups = {
        name: [train_seed(file, overrides, seed, runs, options.overwrite) for seed in seeds]
        for name, file in configs.items()
    }
    trained = {name: load_config(file, overrides) for name, file in configs.items()}
    code = [each for config in trained.values() for each in names_of_code(config)]
    save_figure(learning_figure(groups, code), figure)
    print(f"wrote {figure}")
    for name, folders in groups.items():
        results = [evaluate_seed(folder, options.runs, code) for folder in folders]
        print(f"\n{name}\n\n{format_seeds(results)}\n")
        path = runs / f"{name}_seeds.json"
        rows = [result.to_json() for result in results]
        write_json(path, {"results": rows, "provenance": provenance(trained[name])})
        print(f"wrote {path}")
    return 0


def configs_of(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Config files by the name of their config, and the overrides among the arguments.

    Raises:
        InputError: a config that cannot be used, none, two of one name, or lap times that cannot
            be compared.
    """
    from quadjax.config.loading import load_config
    from quadjax.evaluation.curves import check_lengths

    overrides = [each for each in argv if is_override(each)]
    files = [str(find_config(each)) for each in argv if each not in overrides]
    configs = [load_config(path, overrides) for path in files]
    names = [config.name for config in configs]
    if not names:
        raise InputError("no config: expected at least one preset or YAML file (try --help)")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two of the configs are named {name}, expected names that differ")
    check_lengths({config.name: config.evaluate.length for config in configs})
    return dict(zip(names, files, strict=True)), overrides


def train_seed(
    config: str, overrides: Sequence[str], seed: int, runs: Path, overwrite: bool = False
) -> Path:
    """Train one seed in a separate process; returns the folder of its run.

    Resumes a run that was stopped, and leaves a finished one of the same config as it is.

    Raises:
        InputError: there is a run of that name with another config, or the training failed (its
            message has been printed).
        KeyboardInterrupt: the training was interrupted; it has saved.
    """
    from quadjax.config.loading import load_config
    from quadjax.training.folder import check_same
    from quadjax.training.result import is_finished

    name = f"{load_config(config, overrides).name}_seed{seed}"
    own = [*overrides, f"seed={seed}", f"name={name}"]
    if not overwrite:
        check_same(load_config(config, own), runs / name)
        if is_finished(runs / name):
            return runs / name
    how = "--overwrite" if overwrite else "--resume"
    command = [sys.executable, "-m", "quadjax", "train", config, *own, how, "--output", str(runs)]
    status = subprocess.run(command, check=False).returncode
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status:
        raise InputError(f"training seed {seed} failed with status {status}")
    return runs / name
