"""Write vehicle files of drones that are drawn from the randomization of a config.

A policy can be trained or evaluated on one of them: quadjax train CONFIG vehicle=FILE. A limit of
the commands that is wider than that of the config's drone is replaced by the limit of that drone,
because a policy does not command more.
"""

from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, add_config, parse, seed, whole
from quadjax.core.interruptions import loading


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the drones, write their files and print the paths."""
    parser = Parser("drones", description=__doc__)
    add_config(parser)
    parser.add_argument("--count", type=whole(1, 1000), default=5, help="number of drones (5)")
    parser.add_argument("--seed", type=seed, default=0, help="of the constants (0)")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder of the vehicle files"
    )
    options = parse(parser, arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.studies.drawn_drones import write_drones

    config = load_config(options.config, options.overrides)
    for path in write_drones(config, options.count, options.seed, options.output):
        print(f"wrote {path}")
