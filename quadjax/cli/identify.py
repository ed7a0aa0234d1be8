"""Identify the inner loop's time constants and print them."""

from collections.abc import Sequence

from quadjax.cli.arguments import Parser, add_config, names_of, parse
from quadjax.core.interruptions import loading


def main(arguments: Sequence[str] | None = None) -> None:
    """Identify and print."""
    parser = Parser("identify", description=__doc__)
    add_config(parser, names_of("plant"))
    parser.add_argument(
        "--effects", action="store_true", help="with the unmodeled effects and delays of the plant"
    )
    options = parse(parser, arguments)
    with loading():
        from quadjax.plant.config import load_plant_config, without_effects
        from quadjax.studies.identify import identify, table

    config = load_plant_config(options.config, options.overrides)
    print(table(identify(config if options.effects else without_effects(config))))
