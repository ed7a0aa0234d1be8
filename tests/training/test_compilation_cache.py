"""The compilation cache: in the user's cache folder, private, and only if nothing is configured."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = (
    "import jax; from quadjax.training.compilation_cache import enable_compilation_cache;"
    "before = jax.config.values['jax_compilation_cache_dir']; enable_compilation_cache();"
    "print(before, jax.config.values['jax_compilation_cache_dir'])"
)


def folders(home, **variables):
    own = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    own |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(home)} | variables
    done = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, env=own, check=True
    )
    return done.stdout.split()


@pytest.mark.skipif(sys.platform != "linux", reason="the place of the cache folder is the system's")
def test_it_is_private_and_in_the_users_cache_folder(tmp_path):
    before, after = folders(tmp_path)
    assert before == "None" and Path(after).is_relative_to(tmp_path / "quadjax")
    assert stat.S_IMODE(Path(after).stat().st_mode) == 0o700


def test_a_configured_folder_stays(tmp_path):
    own = str(tmp_path / "own")
    assert folders(tmp_path, JAX_COMPILATION_CACHE_DIR=own) == [own, own]
    assert folders(tmp_path, JAX_ENABLE_COMPILATION_CACHE="false") == ["None", "None"]


def test_a_folder_that_cannot_be_made_means_no_cache(tmp_path):
    (tmp_path / "file").write_text("")
    assert folders(tmp_path / "file") == ["None", "None"]
