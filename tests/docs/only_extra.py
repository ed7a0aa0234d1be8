"""Run a module with the packages of one extra of quadjax alone.

``python -m tests.docs.only_extra EXTRA MODULE ARGUMENTS ..`` finds no other installed package.
"""

import importlib.metadata
import runpy
import sys
import tomllib
from collections.abc import Iterable

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.docs.pages import ROOT


def packages_of(extra: str) -> set[str]:
    """Names of the packages that pip installs with quadjax and an extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own, found = project["optional-dependencies"], {"quadjax"}

    def add(requirements: Iterable[str], extras: Iterable[str] = ("",)) -> None:
        for needed in map(Requirement, requirements):
            name, marker = canonicalize_name(needed.name), needed.marker
            if marker and not any(marker.evaluate({"extra": each}) for each in extras):
                continue
            if name == "quadjax":
                for each in needed.extras:
                    add(own[each])
            elif name not in found:
                found.add(name)
                add(importlib.metadata.requires(name) or (), {"", *needed.extras})

    add([*project["dependencies"], *own[extra]])
    return found


class Missing:
    """A finder of modules that are not installed."""

    def __init__(self, names: set[str]) -> None:
        self._names = names

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Raise for a module of another package."""
        if name.partition(".")[0] in self._names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


if __name__ == "__main__":
    installed = packages_of(sys.argv[1])
    owners = importlib.metadata.packages_distributions().items()
    others = {
        module
        for module, packages in owners
        if not installed & set(map(canonicalize_name, packages)) and module not in sys.modules
    }
    sys.meta_path.insert(0, Missing(others))
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
