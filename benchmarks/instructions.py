"""Instructions, stack and flash of exported policies on emulated processors.

    python -m benchmarks.instructions FILE.qjp ...

A row for each processor, kernel and compiler that is installed (the extra ``test``, and GCC for
ARM). An inference goes from floats to commands; a step of the pilot also has the gates and the
observation. Flash is the code; the words come on top. docs/design/fixed_point.md has the table.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.instructions_boards import Board, vehicles
from benchmarks.instructions_builds import BUILDS
from quadjax.cli import options, script
from quadjax.core.markdown import table
from quadjax.export.read import read_qjp
from quadjax.export.render import sizes_header
from quadjax.export.targets import TARGETS
from quadjax.export.verify.build import Sources
from quadjax.export.verify.result import Skipped
from quadjax.export.words import FixedPolicy

HEAD = ["policy", "build", "inference", "step", "stack", "loading", "flash"]


def rows_of(path: Path, policy: FixedPolicy) -> list[list[str]]:
    """Rows of the table for a policy and its file."""
    words, rows = path.read_bytes(), []
    sizes = [len(layer.bias) for layer in policy.network.layers]
    wide = "-".join(str(x) for x in (policy.network.inputs, *sizes))
    row = np.full(policy.network.inputs, 0.3, np.float32)
    vehicle = vehicles(policy, np.zeros((1, policy.race.state_size), np.float32))
    for processor, builds in BUILDS.items():
        for build in builds:
            with tempfile.TemporaryDirectory() as name:
                sources = Sources.write(TARGETS[processor], None, Path(name), policy)
                (sources.include / "qj_sizes.h").write_text(sizes_header(policy))
                try:
                    board = Board(sources, build, words, Path(name))
                except Skipped as reason:
                    print(f"{processor}, {build.label}: {reason}", file=sys.stderr)
                    continue
                inference, stack = board.count("infer", row)
                step, more = board.count("step", vehicle)
                numbers = (inference, step, max(stack, more), board.loading()[0], board.read_only)
            label = f"{processor}, {build.label}"
            rows.append([wide, label, *(f"{number:,}" for number in numbers)])
    return rows


def instructions(*files: options.ExistingFiles) -> None:
    """Print the table."""
    policies = [(file, read_qjp(file)) for file in files]
    print(table([HEAD, *(row for pair in policies for row in rows_of(*pair))]))


if __name__ == "__main__":
    script(instructions)
