"""Instructions, stack and flash of shipped policies on emulated processors.

    python -m benchmarks.instructions e2e e2e_cyberzoo indi_cyberzoo

A row for each processor, kernel and compiler that is installed (the extra ``test``, and GCC for
ARM). An inference goes from floats to commands; a step of the pilot also has the gates, the
observation and the estimators. Flash is code and tables, without the C library. The rows of
``benchmarks/results/instructions.json`` are those of docs/design/fixed_point.md (make results).
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks import rows
from benchmarks.instructions_boards import Board, sample_vehicle
from benchmarks.instructions_builds import BUILDS, Build
from benchmarks.settings import Tree
from quadjax.cli import options, script
from quadjax.core.resources import policy_file
from quadjax.export.compiler import Skipped
from quadjax.export.conversion import Converted, Options
from quadjax.export.convert import convert_file

FILE = "instructions"


def row_of(path: Path, of: Converted, processor: str, build: Build) -> Tree:
    """The numbers of a policy on a processor; ``Skipped`` without the compiler."""
    with tempfile.TemporaryDirectory() as work:
        board = Board(of, processor, build, Path(work))
    inference, stack = board.count("infer", np.full(of.in_c.network.inputs, 0.3, np.float32))
    step, more = board.count("step", sample_vehicle())
    return {
        "name": f"{path.stem}, {processor}, {build.label}",
        "command": f"python -m benchmarks.instructions {path.stem}",
        "seeds": [],
        "policy": path.name,
        "build": f"{processor}, {build.label}",
        "inference": inference,
        "step": step if build.has_math else None,  # which needs the C library
        "stack": max(stack, more),
        "start": board.start()[0],
        "flash": board.read_only,
    }


def instructions(*policies: options.PolicyFile) -> None:
    """Measure and write the rows."""
    for policy in policies:
        path = policy_file(policy)
        of = convert_file(path, Options("racer", target="cortex-m7", allow_other_race=True))
        for processor, builds in BUILDS.items():
            for build in builds:
                try:
                    row = row_of(path, of, processor, build)
                except Skipped as reason:
                    print(f"{processor}, {build.label}: {reason}", file=sys.stderr)
                    continue
                rows.write(FILE, [row])
                print(row["name"], row["inference"], row["step"], row["stack"], flush=True)


if __name__ == "__main__":
    script(instructions)
