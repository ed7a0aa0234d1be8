"""Folders of data that come with the package: configs, and trained policies.

In a checkout ``configs/`` is at the top of the repository; in a wheel it is inside the package.
"""

from pathlib import Path

from quadjax.core.errors import reading

_PACKAGE = Path(__file__).resolve().parent.parent
_BUNDLED = _PACKAGE / "configs"

CONFIGS = _BUNDLED if _BUNDLED.is_dir() else _PACKAGE.parent / "configs"
PRETRAINED = _PACKAGE / "pretrained"


def preset_names() -> list[str]:
    """Names of the presets: what ``quadjax.load`` and ``quadjax train`` take instead of a file."""
    return sorted(path.stem for path in CONFIGS.glob("*.yaml"))


def find_config(name: Path | str, folder: str = "") -> Path:
    """The path of a config: a file, or a preset by its name without ``.yaml``.

    Args:
        name: of a YAML file, or of a preset.
        folder: the folder of ``configs/`` in which presets are looked up.
    """
    path = Path(name)
    preset = CONFIGS / folder / f"{name}.yaml"
    with reading(name):
        return preset if path.suffix == "" and not path.exists() and preset.is_file() else path


def find_policy(name: Path | str) -> Path:
    """The path of a policy: a file, or a shipped one by its name, with or without ``.npz``."""
    path = Path(name)
    shipped = PRETRAINED / path.with_suffix(".npz") if path.name else path
    bare = path.name == str(path) and path.suffix in ("", ".npz")
    with reading(name):
        return shipped if bare and not path.exists() and shipped.is_file() else path


def policy_names() -> list[str]:
    """Names of the shipped policies."""
    return sorted(p.stem for p in PRETRAINED.glob("*.npz") if "residual" not in p.name)
