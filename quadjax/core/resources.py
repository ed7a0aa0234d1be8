"""Folders of data that come with the package: configs, and trained policies.

In a checkout ``configs/`` is at the top of the repository; in a wheel it is inside the package.
"""

import difflib
from pathlib import Path

from quadjax.core.errors import InputError, reading

_PACKAGE = Path(__file__).resolve().parent.parent
_BUNDLED = _PACKAGE / "configs"

CONFIGS = _BUNDLED if _BUNDLED.is_dir() else _PACKAGE.parent / "configs"
PRETRAINED = _PACKAGE / "pretrained"
REMOVED = {  # presets of earlier versions, and the same race now
    "authors_code": "e2e_paper +authors_code",
    "e2e_adaptive": "e2e +residual +disturbance",
    "e2e_clear": "e2e +fastest +clear",
    "e2e_disturbed": "e2e +disturbance",
    "e2e_estimated": "e2e +estimated",
    "e2e_fastest": "e2e +fastest",
    "e2e_fastest_disturbed": "e2e +fastest +disturbance",
    "e2e_ppo_residual": "e2e_ppo +residual",
    "e2e_race_adaptive": "e2e_race_robust +history",
    "e2e_robust": "e2e +robust",
    "e2e_shac": "e2e",
    "indi_fastest": "indi +fastest",
    "indi_shac": "indi",
}


def preset_names(folder: str = "") -> list[str]:
    """Names of the configs in a folder of ``configs/``, which commands take instead of a file.

    Without ``folder`` they are the presets of ``quadjax.load`` and ``quadjax train``.
    """
    return sorted(path.stem for path in (CONFIGS / folder).glob("*.yaml"))


presets = preset_names  # its name in the public interface


def find_config(name: Path | str, folder: str = "") -> Path:
    """The path of a config: a file, or a preset by its name without ``.yaml``.

    A folder of a preset's name does not hide the preset.

    Args:
        name: of a YAML file, or of a preset.
        folder: the folder of ``configs/`` in which presets are looked up.

    Raises:
        InputError: neither a file nor a preset; with the names of the presets.
    """
    path = Path(name)
    preset = CONFIGS / folder / f"{name}.yaml"
    with reading(name):
        if path.suffix == "" and (path.is_dir() or not path.exists()) and preset.is_file():
            return preset
        if path.exists() or path.is_symlink():
            return path
    names = preset_names(folder)
    if path.name in REMOVED:
        raise InputError(f"{name}: no such preset, write: {REMOVED[path.name]}")
    near = difflib.get_close_matches(path.stem, names, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    kind = "file" if path.suffix else "preset or file"
    raise InputError(f"{name}: no such {kind}{hint}; presets: {', '.join(names)}")


def find_policy(name: Path | str) -> Path:
    """The path of a policy: a file, or a shipped one by its name, with or without ``.npz``."""
    path = Path(name)
    shipped = PRETRAINED / path.with_suffix(".npz") if path.name else path
    bare = path.name == str(path) and path.suffix in ("", ".npz")
    with reading(name):
        hidden = path.is_dir() or not path.exists()
        return shipped if bare and hidden and shipped.is_file() else path


def policy_names() -> list[str]:
    """Names of the shipped policies."""
    return sorted(p.stem for p in PRETRAINED.glob("*.npz") if "residual" not in p.name)
