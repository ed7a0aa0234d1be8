"""Build and run an exported folder with whatever this machine has, and say what held.

    python scripts/verify_c.py DIR

A C compiler of the host, or the one that pip installs, and an emulated Cortex-A9 (pip install
-e '.[verify]') are enough. With arm-linux-gnueabi-gcc, arm-linux-gnueabihf-gcc, qemu-arm,
frama-c and cppcheck on the path more is checked; what is missing is left out with the reason.
Exit status 0: no check failed.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

from quadjax.cli.arguments import Parser, check_writable, count, parse
from quadjax.core.errors import InputError, command_line
from quadjax.core.files import write_json
from quadjax.export.verify.result import FAILED, table_text
from quadjax.export.verify.run import verify


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what export_c.py wrote")
    parser.add_argument(
        "--vectors", type=count, default=5_000, help="vectors for every build (default 5000)"
    )
    parser.add_argument("--flights", type=count, default=0, help="flights of the closed loop")
    parser.add_argument("--json", type=Path, help="write the table there too")
    words = parse(parser)
    check_writable(words.json, (".json",))
    return words


@command_line
def main() -> int:
    """Verify, and print the table."""
    words = arguments()
    if words.vectors < 100:
        raise InputError(f"--vectors {words.vectors}: expected at least 100")

    def announce(name: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\033[K{name} ..", end="", file=sys.stderr, flush=True)

    results = verify(words.folder, words.vectors, words.flights, announce)
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print(table_text(results))
    if words.json:
        write_json(words.json, [dataclasses.asdict(result) for result in results])
    return int(any(result.verdict == FAILED for result in results))


if __name__ == "__main__":
    main()
