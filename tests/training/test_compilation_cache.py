"""The compilation cache: in the user's cache folder, private, and only if nothing is configured."""

import stat
import sys
from pathlib import Path

import jax
import pytest

from quadjax.core.compilation_cache import enable_compilation_cache

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_enable_compilation_cache",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)
pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="the place of the cache folder is the system's"
)


@pytest.fixture
def enabled(monkeypatch):
    """A function of the user's cache folder and JAX's settings: the cache that is then used."""
    before = {name: jax.config.values[name] for name in SETTINGS}

    def enable(home, folder=None, on=True):
        monkeypatch.setenv("XDG_CACHE_HOME", str(home))
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_enable_compilation_cache", on)
        enable_compilation_cache()
        return jax.config.values["jax_compilation_cache_dir"]

    yield enable
    for name, value in before.items():
        jax.config.update(name, value)


def test_it_is_private_and_in_the_users_cache_folder(enabled, tmp_path):
    folder = enabled(tmp_path)
    assert Path(folder).is_relative_to(tmp_path / "quadjax")
    assert stat.S_IMODE(Path(folder).stat().st_mode) == 0o700
    for name in ("whole-cache", "whole-atime", "cut-cache"):  # the last: its process was killed
        (Path(folder) / name).touch()
    assert enabled(tmp_path) == folder
    assert {path.name for path in Path(folder).iterdir()} == {"whole-cache", "whole-atime"}
    Path(folder).chmod(0o777)
    assert enabled(tmp_path) is None  # others could write to it


def test_a_configured_folder_stays_and_one_that_cannot_be_made_is_none(enabled, tmp_path):
    assert enabled(tmp_path, folder=str(tmp_path / "own")) == str(tmp_path / "own")
    assert enabled(tmp_path, on=False) is None
    (tmp_path / "file").write_text("")
    assert enabled(tmp_path / "file") is None
