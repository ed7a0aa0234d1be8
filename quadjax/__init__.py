"""quadjax: time-optimal quadcopter racing policies, from simulation to fixed-point C.

The public interface is listed in ``__init__.pyi``, which type checkers and editors read. Each name
is imported when it is first used, so that ``import quadjax`` takes milliseconds and does not
import JAX.
"""

import ast
import importlib
from pathlib import Path
from typing import Any

import quadjax.core.forks  # noqa: F401  from here on, forks are known

__version__ = "0.2.0.dev0"


def _public() -> dict[str, tuple[str, str]]:
    """Module and object of each public name."""
    listed = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [line for line in listed.body if isinstance(line, ast.ImportFrom)]
    names = [(line.module, name) for line in imports for name in line.names]
    return {name.asname or name.name: (module or "", name.name) for module, name in names}


_PUBLIC = _public()
__all__ = sorted([*_PUBLIC, "__version__"])


def __getattr__(name: str) -> Any:
    """A public name, imported now (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PUBLIC[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return __all__
