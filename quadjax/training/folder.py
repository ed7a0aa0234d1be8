"""The folder of a training run: whose it is, and whether it may be used, resumed or removed."""

import shutil
from pathlib import Path

from omegaconf import OmegaConf

from quadjax.config.loading import to_yaml
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text


def claim_directory(config: Config, directory: Path, resume: bool) -> None:
    """Write the config, or see that the one that is there is the same.

    Raises:
        InputError: a run that is not to be resumed, or one of another config.
    """
    path = directory / "config.yaml"
    latest = directory / "checkpoints" / "latest"
    if path.exists() and latest.exists() and any(latest.iterdir()):
        if not resume:
            raise InputError(
                f"{directory} holds a run already: go on with --resume, begin anew with "
                "--overwrite, or choose another name=NAME"
            )
        check_same(config, directory)
    write_text(path, to_yaml(config))


def check_same(config: Config, directory: Path) -> None:
    """Raise an ``InputError`` that names the key in which the run that is there differs."""
    path = directory / "config.yaml"
    if not path.exists():
        return
    before = flat(OmegaConf.to_container(OmegaConf.load(path)))
    now = flat(OmegaConf.to_container(OmegaConf.create(to_yaml(config))))
    for key in [*now, *before]:
        if before.get(key) != now.get(key):
            raise InputError(
                f"{path} has {key}: {before.get(key)}, the run to go on with {key}: "
                f"{now.get(key)}: take the same config, begin anew with --overwrite, or choose "
                "another name=NAME"
            )


def flat(tree: object, prefix: str = "") -> dict[str, object]:
    """The leaves of nested mappings by dotted key; a list is a leaf."""
    if not isinstance(tree, dict) or not tree:
        return {prefix.rstrip("."): tree}
    return {
        k: v for name, child in tree.items() for k, v in flat(child, f"{prefix}{name}.").items()
    }


def remove_run(directory: Path) -> None:
    """Delete what a run left; anything else stays.

    Raises:
        InputError: a folder that holds something but no run.
    """
    if directory.exists() and any(directory.iterdir()):
        if not (directory / "config.yaml").exists():
            raise InputError(f"{directory} holds no run (no config.yaml): not deleted")
        shutil.rmtree(directory)
