"""Folders of data that come with the package: configs, and policies as trained.

In a checkout ``configs/`` is at the top of the repository; in a wheel it is inside the package.
"""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent
_BUNDLED = _PACKAGE / "configs"

CONFIGS = _BUNDLED if _BUNDLED.is_dir() else _PACKAGE.parent / "configs"
PRETRAINED = _PACKAGE / "pretrained"
