"""Eight host devices for the tests of learners that share a batch; programs compiled once."""

import os
import tempfile

# Programs that several tests share are compiled once a session, whichever process they run in:
# JAX reads these when it is imported, and every process that a test starts inherits them.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    CACHE = tempfile.TemporaryDirectory(prefix="quadjax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"

import jax  # noqa: E402

jax.config.update("jax_num_cpu_devices", 8)  # before anything starts the backend
