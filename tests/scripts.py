"""Run a script of ``benchmarks/`` in this process, as the command line does."""

import importlib

from quadjax import cli
from quadjax.core.errors import as_command


def run_script(name: str, *arguments: object) -> int:
    """The exit status of ``python -m benchmarks.NAME ARGUMENTS``."""
    script = getattr(importlib.import_module(f"benchmarks.{name}"), name)
    words = [str(each) for each in arguments]
    return as_command(cli.call)(script, f"benchmarks.{name}", words)
