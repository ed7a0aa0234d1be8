"""Settings of the test session: one compilation cache, and eight host devices.

Tests that take more than a few seconds have the marker ``slow``: ``make test`` leaves them out and
``make test-all`` runs them.
"""

import os
import tempfile

# Programs that several tests share are compiled once in a session, whichever process they run in:
# JAX reads the variables when it is imported, and every worker and every process that a test starts
# inherits them.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    CACHE = tempfile.TemporaryDirectory(prefix="quadjax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"

# Devices of the host wait for one another in a collective operation, by default 40 s at most; with
# fewer cores than devices and other tests beside them it can be longer.
os.environ["XLA_FLAGS"] = " ".join(
    [
        os.environ.get("XLA_FLAGS", ""),
        "--xla_cpu_collective_call_terminate_timeout_seconds=600",
        "--xla_cpu_collective_timeout_seconds=600",
    ]
)

import jax  # noqa: E402

from tests.skips import pytest_sessionfinish, pytest_terminal_summary  # noqa: E402, F401

# Started at once: a training in this process would ask for a device for each core.
jax.config.update("jax_num_cpu_devices", 8)
jax.devices()
