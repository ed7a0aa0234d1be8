"""Write the policy of one drone, from a policy that observes the drone's constants.

CONFIG is a race with the drone, such as e2e_race vehicle=mine.yaml. The constants of its vehicle
file enter the first layer of the network; the new file has no such observation. A note names the
constants that are outside the range of the policy's training.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, add_config, check_outputs, parse
from quadjax.core.interruptions import loading


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the policy file and print its path."""
    parser = Parser("specialize", description=__doc__)
    add_config(parser)
    parser.add_argument(
        "--policy", type=Path, required=True, metavar="FILE.npz", help="that observes constants"
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FILE.npz", help="policy file to write"
    )
    options = parse(parser, arguments)
    check_outputs(options, output=(".npz",))
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.policy.file import Policy
        from quadjax.studies.specialize import outside, specialize

    config = load_config(options.config, options.overrides)
    policy = Policy.load(options.policy, config)
    own = specialize(policy, config, str(options.policy))
    if names := outside(policy, config):
        others = "outside the range of the policy's training"
        print(f"note: constants of the drone {others}: {', '.join(names)}", file=sys.stderr)
    own.save(options.output)
    print(f"wrote {options.output}")
