"""Train a config over several seeds, one after the other, and print what each came to.

Laps are deterministic from hover; 'sampled' is the mean of sampled flights from hover, 'random
starts' how many of as many sampled flights from random starts flew every lap.
"""

import dataclasses
from pathlib import Path

from quadjax.commands import Parser, count, parse
from quadjax.config import load_config
from quadjax.errors import command_line
from quadjax.files import write_json


@command_line
def main() -> int:
    """Train, fly and tabulate."""
    parser = Parser(description=__doc__)
    parser.add_argument("config", help="YAML file, as for training")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--seeds", type=count, default=5, help="how many, from 0 (5)")
    parser.add_argument("--flights", type=count, default=100, help="sampled flights (100)")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="where runs go (runs)")
    arguments = parse(parser)
    name = load_config(arguments.config, arguments.words).name
    from quadjax import seeds

    runs = Path(arguments.runs)
    folders = [
        seeds.train_seed(arguments.config, arguments.words, seed, runs)
        for seed in range(arguments.seeds)
    ]
    results = [seeds.judge_seed(folder, arguments.flights) for folder in folders]
    print(seeds.format_seeds(results))
    path = runs / f"{name}_seeds.json"
    write_json(path, [dataclasses.asdict(result) for result in results])
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    main()
