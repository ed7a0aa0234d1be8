"""Settings of the test session: quick compilation, a cache of it, and four host devices.

Tests that take more than a few seconds have the marker ``slow``: ``make test`` leaves them out and
``make test-all`` runs them.
"""

import gc
import os
import signal
from pathlib import Path

# JAX and XLA read these variables when they are imported; every worker and every process that a
# test starts inherits them.
#
# Programs are compiled once, also for the next sessions. JAX limits no size: with a limit, one
# entry of a process that was killed while it wrote makes JAX write no further one. JAX's keys
# contain the path of the folder. It is resolved, so that worktrees that link to one folder share
# its programs.
CACHE = (Path(__file__).parents[1] / ".pytest_cache/jax").resolve()
MAX_BYTES = 2**31
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Compiled soon rather than well: most programs of the tests run once. Devices of the host wait for
# one another in a collective operation, by default 40 s at most: with fewer cores than devices and
# other tests beside them it can be longer.
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = (
        "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
        "--xla_cpu_collective_call_terminate_timeout_seconds=600 "
        "--xla_cpu_collective_timeout_seconds=600"
    )

import jax  # noqa: E402
import pytest  # noqa: E402

from quadjax.learners import parallel  # noqa: E402
from tests.cpu_time import pytest_runtest_call  # noqa: E402, F401
from tests.skips import pytest_sessionfinish, pytest_terminal_summary  # noqa: E402, F401

# Started at once: a training in this process would ask for a device for each core.
jax.config.update("jax_num_cpu_devices", 4)
jax.devices()
# A shell starts what it runs in the background with Ctrl-C ignored, and processes inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
# JAX makes many objects while it traces, and Python's default thresholds make the collector visit
# all of them again and again.
gc.set_threshold(100_000, 20, 20)


def pytest_collection_finish() -> None:
    """Exclude the imported modules from the garbage that is looked for."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def optimized(monkeypatch):
    """Trainings are compiled well rather than soon, for those of many steps."""
    options = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
    options |= parallel.compile_options()
    monkeypatch.setattr(parallel, "compile_options", lambda: options)


def pytest_configure(config: pytest.Config) -> None:
    """Remove the oldest compiled programs beyond a size, before any worker starts."""
    if hasattr(config, "workerinput"):
        return
    total = 0
    for path in sorted(CACHE.glob("*-cache"), key=lambda path: -path.stat().st_mtime):
        total += path.stat().st_size
        if total > MAX_BYTES:
            path.unlink(missing_ok=True)
