"""Turn a policy file into fixed-point C that an autopilot can trust.

    python scripts/export_c.py POLICY.npz --out DIR

writes the network, the observation, the disturbance estimator and a Paparazzi module as C, with
self-tests, and a report of what was proven. ``scripts/verify_c.py DIR`` then builds and runs it
all. docs/on_your_drone.md says how to put it on a drone.
"""

import argparse
from pathlib import Path

from quadjax.cli.arguments import Parser, parse
from quadjax.core.errors import command_line
from quadjax.export.convert_policy import Request, write_folder
from quadjax.export.ranges import add_range_option, parse_overrides
from quadjax.export.report import report_text


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path, help="policy file (.npz)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the C")
    parser.add_argument("--name", help="prefix of every C symbol; default: the file's name")
    add_range_option(
        parser, "declare +-R for an input instead of the default, a power of two: position=16"
    )
    parser.add_argument("--track", help="track file of configs/tracks, or a path to one")
    parser.add_argument("--config", type=Path, help="training config whose race the policy flies")
    parser.add_argument("--sample-rate", type=float, default=512.0, help="of the estimator, Hz")
    parser.add_argument("--cutoff", type=float, default=8.0, help="of the estimator, Hz")
    return parse(parser)


@command_line
def main() -> None:
    """Convert, write, and print the report."""
    words = arguments()
    request = Request(
        policy=words.policy,
        out=words.out,
        ranges=parse_overrides(words.ranges),
        name=words.name,
        track=words.track,
        config=words.config,
        sample_rate=words.sample_rate,
        cutoff=words.cutoff,
    )
    converted, report = write_folder(request)
    name = converted.origin.name
    print(report_text(report, name))
    print(f"Written to {words.out}. Next: python scripts/verify_c.py {words.out}")


if __name__ == "__main__":
    main()
