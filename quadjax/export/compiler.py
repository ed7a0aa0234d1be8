"""Compilers of this machine, and their flags."""

import dataclasses
import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


class Skipped(Exception):
    """A check that cannot run on this machine; the message gives the reason."""


class Failed(Exception):
    """A check that failed; the message gives the reason."""


@dataclasses.dataclass(frozen=True)
class Compiler:
    """A compiler with the flags that make it build for one machine."""

    name: str
    command: tuple[str, ...]
    flags: tuple[str, ...]

    def build(self, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()) -> Path:
        """Compile and link.

        Raises:
            Failed: with the first line of the compiler's output.
        """
        files = [*map(str, sources), "-o", str(output)]
        command = [*self.command, *self.flags, *files, *extra]  # a library follows its users
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if done.returncode:
            words = ("error:", "warning", "undefined")
            lines = [line for line in done.stderr.splitlines() if any(w in line for w in words)]
            raise Failed(f"{self.name}: {(lines or done.stderr.splitlines() or ['failed'])[0]}")
        return output


def has_module(name: str) -> bool:
    """Whether a Python package is installed."""
    return importlib.util.find_spec(name) is not None


def host() -> Compiler:
    """The host's C compiler: cc, gcc, clang, or the one that pip installs."""
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return Compiler(name, (name,), ("-std=c99", "-O2"))
    if has_module("ziglang"):
        command = (sys.executable, "-m", "ziglang", "cc")
        return Compiler("zig cc", command, ("-std=c99", "-O2", "-fno-sanitize=all"))
    raise Skipped("no C compiler on this machine; pip install ziglang")
