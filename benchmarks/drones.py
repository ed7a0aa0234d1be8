"""Write vehicle files of drones that are drawn from the randomization of a config.

A policy can be trained or evaluated on one of them: quadjax train CONFIG vehicle=FILE. A limit of
the commands that is wider than that of the config's drone is replaced by the limit of that drone,
because a policy does not command more.

    python -m benchmarks.drones e2e_race_robust --count 5 --output runs/drones
"""

from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Config, Folder, Overrides, Seed, whole
from quadjax.config.loading import load_config
from quadjax.studies.drawn_drones import write_drones


def drones(
    config: Config,
    /,
    *overrides: Overrides,
    output: Folder,
    count: Annotated[int, Parameter(converter=whole(1, 1000))] = 5,
    seed: Seed = 0,
) -> None:
    """Draw the drones, write their files and print the paths.

    Args:
        output: Folder of the vehicle files.
        count: Number of drones.
        seed: Of the constants.
    """
    for path in write_drones(load_config(config, overrides), count, seed, output):
        print(f"wrote {path}")


if __name__ == "__main__":
    script(drones)
