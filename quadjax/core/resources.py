"""Folders of data that come with the package: configs, and trained policies.

In a checkout ``configs/`` is at the top of the repository; in a wheel it is inside the package.
"""

from collections.abc import Sequence
from pathlib import Path

from quadjax.core.errors import InputError, close_match, reading, short

_PACKAGE = Path(__file__).resolve().parent.parent
_BUNDLED = _PACKAGE / "configs"

CONFIGS = _BUNDLED if _BUNDLED.is_dir() else _PACKAGE.parent / "configs"
PRETRAINED = _PACKAGE / "pretrained"
RESIDUALS = {"standin_residual", "cyberzoo_residual"}  # there, next to the policies
POLICY_FILE = "policy.npz"  # in the folder of a training run
KINDS = {  # what the folders of configs/ hold
    "": "presets",
    "parts": "parts of presets (+NAME; a prefix e2e_ or indi_ limits a part to that preset and is "
    "left out of NAME)",
    "tracks": "tracks",
    "vehicles": "vehicles",
    "plant": "plants",
    "fit": "fit configs",
    "conditions": "lists of conditions",
    "sweeps": "sweeps",
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
        if str(name) and (path.exists() or path.is_symlink()):
            return path
    refuse_part(str(name))
    names, kind = preset_names(folder), KINDS.get(folder, folder)
    place, hint = _listed([path.parent]), close_match(path.stem, names)
    listed = f"{kind} of quadjax: {', '.join(names)}"
    if "=" in str(name):
        raise InputError(f"{name}: an override, allowed after the name of a config: {listed}")
    raise InputError(f"{name or repr(name)}: no such file in {place}{hint}; {listed}")


def refuse_part(name: str) -> None:
    """Raise an ``InputError`` for ``+PART`` where a config, or a change of one key, is expected."""
    if name.startswith("+"):
        raise InputError(f"{name}: a part needs the config of a race before it: 'e2e {name}'")


def find_file(name: str, folders: Sequence[Path], kind: str = "") -> Path:
    """A file that a config names: in one of the folders, or in its subfolder ``kind``.

    The last folder that is searched is ``configs/kind``. The suffix ``.yaml`` may be left out.

    Raises:
        InputError: no such file.
    """
    names = [name] if Path(name).suffix == ".yaml" else [name, f"{name}.yaml"]
    places = [place for folder in folders for place in (folder, folder / kind)]
    places.append(CONFIGS / kind)
    paths = [place / file for place in places for file in names]
    with reading(short(name)):
        present = [path for path in paths if path.exists()]
    for path in present:
        if not path.is_dir():
            return path
    if present:
        raise InputError(f"{present[0]}: is a directory, expected a file")
    stems = [path.stem for place in places for path in sorted(place.glob("*.yaml"))]
    hint = close_match(Path(name).stem, stems)
    kinds, listed = KINDS.get(kind, kind).partition(" (")[0], ", ".join(preset_names(kind))
    shipped = f"; {kinds} of quadjax: {listed}" if kind else ""
    place = _listed([*folders, places[-1]])
    raise InputError(f"{short(name)}: no such file in {place}{hint}{shipped}")


def _listed(folders: Sequence[Path]) -> str:
    """Folders as text, each once."""
    names = ("the current folder" if folder == Path() else str(folder) for folder in folders)
    return " or ".join(dict.fromkeys(names))


def find_policy(name: Path | str) -> Path:
    """The path of a policy: a file, that of a run's folder, or a shipped one by its name.

    Raises:
        InputError: a name that the file system cannot have.
    """
    path = Path(name)
    shipped = PRETRAINED / path.with_suffix(".npz") if path.name else path
    bare = path.name == str(path) and path.suffix in ("", ".npz")
    with reading(name):
        if is_run(path):
            return path / POLICY_FILE
        hidden = path.is_dir() or not path.exists()
        return shipped if bare and hidden and shipped.is_file() else path


def policy_file(name: Path | str) -> Path:
    """The path of a policy, as ``find_policy``.

    Raises:
        InputError: no such file, or the folder of no run.
    """
    path = find_policy(name)
    if path.exists() and not path.is_dir():
        return path
    fault = f"no {POLICY_FILE} in this folder" if path.is_dir() else "no such file"
    allowed = (
        f"a policy file, the folder of a run, or a shipped policy: {', '.join(policy_names())}"
    )
    raise InputError(f"{str(name) or repr(name)}: {fault}, allowed: {allowed}")


def is_run(folder: Path) -> bool:
    """Whether a path is the folder of a training run that has written a policy."""
    return (folder / POLICY_FILE).is_file()


def policy_names() -> list[str]:
    """Names of the shipped policies."""
    return sorted({path.stem for path in PRETRAINED.glob("*.npz")} - RESIDUALS)
