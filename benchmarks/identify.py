"""Identify the inner loop's time constants, for docs/design/plant.md.

python -m benchmarks.identify standin
"""

from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Flag, Overrides, config_of
from quadjax.plant.config import load_plant_config, without_effects
from quadjax.studies.identify import identify as identify_loop
from quadjax.studies.identify import table


def identify(
    config: Annotated[str, Parameter(name="CONFIG"), config_of("plant")],
    /,
    *overrides: Overrides,
    effects: Flag = False,
) -> None:
    """Identify the inner loop's time constants and print them.

    Args:
        effects: With the unmodeled effects and delays of the plant.
    """
    plant = load_plant_config(config, overrides)
    print(table(identify_loop(plant if effects else without_effects(plant))))


if __name__ == "__main__":
    script(identify)
