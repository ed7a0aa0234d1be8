"""The folder of a training run: checks of the run in it, and the files of training."""

from pathlib import Path
from typing import Any

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.folders import MARKER, check_kind, kind_of, remove_files
from quadjax.core.sections import parse_yaml, read_yaml
from quadjax.core.yaml_files import flatten

KIND = "training"
FREE = ("run.devices", "run.checkpoint_seconds", "run.tensorboard", "run.compilation_cache")
FILES = (
    "config.yaml",
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
    MARKER,
)


def prepare_folder(config: Config, folder: Path, resume: bool, overwrite: bool) -> None:
    """Write the config to a run's folder, after the checks that it may be used.

    Args:
        config: of the run.
        folder: of the run; locked by the caller.
        resume: continue the run that the folder holds, if there is one.
        overwrite: remove the run that the folder holds, if there is one.

    Raises:
        InputError: a run that is neither resumed nor overwritten, or one of another config.
    """
    check_kind(folder, KIND)
    if overwrite:
        remove_files(folder, FILES)
    latest = folder / "checkpoints" / "latest"
    if (folder / "config.yaml").exists() and latest.exists() and any(latest.iterdir()):
        if not resume:
            raise InputError(
                f"{folder} already contains a run: resume it (--resume), replace it (--overwrite) "
                "or choose another name"
            )
        check_same(config, folder)
    write_text(folder / "config.yaml", config.to_yaml())


def check_same(config: Config, folder: Path) -> None:
    """Raise an ``InputError`` that names the key in which the folder's run differs.

    Keys that change no number (``FREE``) may differ.
    """
    path = folder / "config.yaml"
    if not path.exists() or kind_of(folder) not in (None, KIND):
        return
    own: Any = parse_yaml(config.to_yaml(), "config")
    before, now = flatten(read_yaml(path)), flatten(own)
    for key in [*now, *before]:
        if key not in FREE and before.get(key) != now.get(key):
            raise InputError(
                f"{path} has {key}: {before.get(key)}, the new config {key}: {now.get(key)}: use "
                "the same config, replace the run (--overwrite) or choose another name"
            )
