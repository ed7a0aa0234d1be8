"""JAX's persistent compilation cache: a second start of the same program does not compile again."""

import hashlib
import os
import platform
import sys
from pathlib import Path

import jax

from quadjax.core.forks import refuse_forked
from quadjax.core.provenance import cpu_info, processor

MAX_BYTES = 2 * 2**30  # of the folder; the least recently used entries are removed
MIN_COMPILE_S = 0.5  # programs that compile faster are not saved


def enable_compilation_cache() -> None:
    """Use a folder in the user's cache directory, unless one is configured already.

    ``JAX_COMPILATION_CACHE_DIR``, ``jax.config`` and ``JAX_ENABLE_COMPILATION_CACHE=0`` take
    precedence. Where the folder cannot be written, or others can write to it, nothing is cached.

    Raises:
        InputError: a process in which JAX cannot compile; see ``quadjax.core.forks``.
    """
    refuse_forked()
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] or not settings["jax_enable_compilation_cache"]:
        return
    folder = cache_folder() / "jax" / _machine()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError:
        return
    # Cached programs are executed, so only the user may have write access to the folder.
    owner = os.getuid() if hasattr(os, "getuid") else status.st_uid
    if status.st_uid != owner or status.st_mode & 0o022 or not os.access(folder, os.W_OK):
        return
    # JAX writes no more entries next to one that has no time because its process was killed.
    times = {path.name.removesuffix("-atime") for path in folder.glob("*-atime")}
    for path in folder.glob("*-cache"):
        if path.name.removesuffix("-cache") not in times:
            path.unlink(missing_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_S)


def cache_folder() -> Path:
    """The folder for files that can be made again: per user, by the system's convention."""
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "quadjax"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "quadjax"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "quadjax"


def _machine() -> str:
    """A name for the processor: its programs may not run on another one with the same home."""
    info = cpu_info()
    text = "".join([platform.machine(), processor(), info.get("flags", "")])
    return hashlib.sha256(text.encode()).hexdigest()[:12]
