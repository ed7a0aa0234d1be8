"""Print the resolved config of a preset or a YAML file, with every key."""

from collections.abc import Sequence

from quadjax.cli.arguments import Parser, add_config, parse
from quadjax.core.interruptions import loading


def main(arguments: Sequence[str] | None = None) -> None:
    """Load, check and print a config."""
    parser = Parser("config", description=__doc__)
    add_config(parser)
    options = parse(parser, arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.reference import commented_yaml

    print(commented_yaml(load_config(options.config, options.overrides)), end="")
