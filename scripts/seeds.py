"""Train configs over several seeds, one after the other, and print what each came to.

A run that has finished is not trained again. Laps are deterministic from hover; 'sampled' is the
mean of sampled flights from hover, 'random starts' how many of as many sampled flights from random
starts flew every lap. The figure has the learning curves of all configs side by side.
"""

import dataclasses
from pathlib import Path

from quadjax.cli.arguments import Parser, check_writable, count, count_up_to, parse
from quadjax.config.checks import MOST_RUNS
from quadjax.core.errors import command_line
from quadjax.core.files import write_json


@command_line
def main() -> int:
    """Train, draw, fly and tabulate."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "words",
        nargs="+",
        metavar="CONFIG|key=value",
        help="YAML files, as for training, and changes to all of them",
    )
    parser.add_argument("--seeds", type=count, default=5, help="how many, from 0 (5)")
    parser.add_argument(
        "--flights", type=count_up_to(MOST_RUNS), default=100, help="sampled flights (100)"
    )
    parser.add_argument("--runs", default="runs", metavar="DIR", help="where runs go (runs)")
    parser.add_argument("--figure", metavar="FILE", help="learning curves (runs/NAMES_seeds.png)")
    arguments = parse(parser)
    from quadjax.evaluation.figures import save_figure
    from quadjax.evaluation.learning_curves import learning_figure
    from quadjax.training import seeds

    configs, words = seeds.configs_of(arguments.words)
    runs = Path(arguments.runs)
    figure = Path(arguments.figure or runs / f"{'_and_'.join(configs)}_seeds.png")
    check_writable(figure, (".png", ".svg", ".pdf"))
    groups = {
        name: [seeds.train_seed(config, words, seed, runs) for seed in range(arguments.seeds)]
        for name, config in configs.items()
    }
    save_figure(learning_figure(groups), figure)
    print(f"wrote {figure}")
    for name, folders in groups.items():
        results = [seeds.judge_seed(folder, arguments.flights) for folder in folders]
        print(f"\n{name}\n\n{seeds.format_seeds(results)}\n")
        path = runs / f"{name}_seeds.json"
        write_json(path, [dataclasses.asdict(result) for result in results])
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    main()
