"""Eight host devices for the tests of learners that share a batch; programs compiled once."""

import tempfile

import jax

jax.config.update("jax_num_cpu_devices", 8)  # before anything starts the backend
# Programs that several tests share are compiled once a session.
CACHE = tempfile.TemporaryDirectory(prefix="quadjax-tests-")
jax.config.update("jax_compilation_cache_dir", CACHE.name)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
