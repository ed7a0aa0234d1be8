"""The folder of a training run: checks of the run in it, and the files of training."""

from pathlib import Path

from quadjax.config.loading import load_config, names_of_code
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, close_match
from quadjax.core.files import check_file, write_bytes, write_text
from quadjax.core.folders import check_kind, kind_of, remove_files
from quadjax.core.section_keys import value_at
from quadjax.core.yaml_files import flatten
from quadjax.training.result import is_finished
from quadjax.vehicle.residual import is_shipped

KIND = "training"
RESUMABLE_KEYS = tuple(
    f"run.{key}" for key in ("devices", "checkpoint_seconds", "tensorboard", "compilation_cache")
)
INPUTS = {  # files of a config, and their copies in the run's folder
    "vehicle.residual": "inputs/residual.npz",
    "run.initial_policy": "inputs/initial_policy.npz",
}
FILES = (
    "config.yaml",
    *INPUTS.values(),
    "metrics.csv",
    "summary.json",
    "policy.npz",
    "policy_last.npz",
    "laps.json",
    "laps_deterministic.json",
    "trajectory.png",
    "curves.png",
    "checkpoints",
    "tensorboard",
)


REPLACE = "replace the run (--overwrite) or choose another name"


def prepare_folder(config: Config, folder: Path, resume: bool, overwrite: bool) -> Config:
    """Write the config and the files that it names to a run's folder, if it may be used.

    Args:
        config: of the run.
        folder: of the run; locked by the caller.
        resume: continue the run that the folder holds, if there is one.
        overwrite: remove the run that the folder holds, if there is one.

    Returns:
        The config with the copies of its files, in the folder.

    Raises:
        InputError: a run that is neither resumed nor overwritten, or one of another config.
    """
    check_kind(folder, KIND)
    contents = _inputs(config)
    if overwrite:
        remove_files(folder, FILES)
    saved = any((folder / "checkpoints" / "latest").glob("*"))
    if saved or (folder / "policy.npz").exists():
        if not resume:
            raise InputError(
                f"{folder} already contains a run: resume it (--resume), replace it "
                "(--overwrite) or choose another name"
            )
        check_same(config, folder)
        if not saved and not is_finished(folder):
            raise InputError(f"{folder} has a policy but no checkpoint to resume from: {REPLACE}")
    for key, content in contents.items():
        write_bytes(folder / INPUTS[key], content)
    write_text(folder / "config.yaml", _with_inputs(config, contents).to_yaml())
    return _with_inputs(config, contents, folder)


def check_started(folder: Path) -> None:
    """Raise an ``InputError`` if no training has begun in a folder that is named to resume it."""
    if any((folder / file).exists() for file in FILES):
        return
    names = sorted(path.parent.name for path in folder.parent.glob("*/config.yaml"))
    runs = f"{', '.join(names) or 'none'}{close_match(folder.name, names)}"
    raise InputError(f"{folder}: no run to resume (without --resume one starts); runs: {runs}")


def _inputs(config: Config) -> dict[str, bytes]:
    """The contents of the files that a config names, except files of the package, by key."""
    named = {key: value_at(config, key) for key in INPUTS}
    paths = {key: str(path) for key, path in named.items() if path and not is_shipped(str(path))}
    for path in paths.values():
        check_file(path)
    return {key: Path(path).read_bytes() for key, path in paths.items()}


def _with_inputs(config: Config, contents: dict[str, bytes], folder: Path = Path()) -> Config:
    """The config with the copies of its files."""
    for key in contents:
        config = config.at(key, str(folder / INPUTS[key]))
    return config


def check_same(config: Config, folder: Path) -> None:
    """Raise an ``InputError`` that names the key in which the folder's run differs.

    Keys that change no number (``RESUMABLE_KEYS``) may differ.
    """
    path = folder / "config.yaml"
    if not path.exists() or kind_of(folder) not in (None, KIND):
        return
    contents = _inputs(config)
    saved = load_config(path, code=names_of_code(config))
    before, now = (
        flatten(one.model_dump(by_alias=True))
        for one in (saved, _with_inputs(config, contents, folder))
    )
    for key in [*now, *before]:
        if key not in RESUMABLE_KEYS and before.get(key) != now.get(key):
            raise InputError(
                f"{path} has {key}: {before.get(key)}, the new config {key}: {now.get(key)}: use "
                f"the same config, {REPLACE}"
            )
    for key, content in contents.items():
        copy = folder / INPUTS[key]
        if copy.exists() and copy.read_bytes() != content:
            raise InputError(
                f"{copy} differs from {key} of the new config, {value_at(config, key)}: use the "
                f"same file, {REPLACE}"
            )
