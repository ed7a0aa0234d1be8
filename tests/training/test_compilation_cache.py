"""The compilation cache: in the user's cache folder, private, and only if nothing is configured."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = (
    "import jax; from quadjax.core.compilation_cache import enable_compilation_cache;"
    "before = jax.config.values['jax_compilation_cache_dir']; enable_compilation_cache();"
    "print(before, jax.config.values['jax_compilation_cache_dir'])"
)


def python(home, *arguments, **variables):
    """The output of Python with ``home`` as the user's cache folder."""
    own = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    own |= {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(home)} | variables
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, env=own, check=True
    )
    return done.stdout.split()


def folders(home, **variables):
    return python(home, "-c", CODE, **variables)


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


@pytest.mark.skipif(sys.platform != "linux", reason="the place of the cache folder is the system's")
def test_a_folder_that_others_can_write_to_is_not_used(tmp_path):
    _, folder = folders(tmp_path)
    Path(folder).chmod(0o777)
    assert folders(tmp_path) == ["None", "None"]


MANY = """
import jax, quadjax.core.compilation_cache as cache
cache.MAX_BYTES, cache.MIN_SECONDS = 30_000, 0.0
cache.enable_compilation_cache()
for size in range(2, 12):
    jax.jit(lambda x: x * size + size)(jax.numpy.zeros(size)).block_until_ready()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the place of the cache folder is the system's")
def test_its_size_is_bounded(tmp_path):
    python(tmp_path, "-c", MANY)
    sizes = [path.stat().st_size for path in tmp_path.rglob("*-cache")]
    assert sizes and sum(sizes) <= 30_000


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the place of the cache folder is the system's")
def test_commands_use_it_unless_it_is_off(tmp_path):
    policy = ROOT / "quadjax/pretrained/e2e_nominal.npz"
    command = ["-m", "quadjax", "evaluate", "e2e_shac", "--policy", policy, "--laps", "1"]
    command += ["--deterministic", "--runs", "1"]
    python(tmp_path / "off", *command, "run.compilation_cache=false")
    assert not list((tmp_path / "off").rglob("*-cache"))
    python(tmp_path / "on", *command)
    first = {path.name for path in (tmp_path / "on").rglob("*-cache")}
    python(tmp_path / "on", *command)
    assert first and {path.name for path in (tmp_path / "on").rglob("*-cache")} == first
