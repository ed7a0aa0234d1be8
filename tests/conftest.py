<<<<<<< HEAD
"""Eight host devices for the sharding tests; strict promotion for the rooms that keep to it."""

import tempfile
from collections.abc import Iterator
=======
"""Eight host devices, for the tests of learners that share a batch among devices."""
>>>>>>> tests

import jax

jax.config.update("jax_num_cpu_devices", 8)  # before anything starts the backend
<<<<<<< HEAD
# Programs that several tests share are compiled once a session.
CACHE = tempfile.TemporaryDirectory(prefix="quadjax-tests-")
jax.config.update("jax_compilation_cache_dir", CACHE.name)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

RANKS = {"jax_numpy_rank_promotion": "raise"}
TYPES = {"jax_numpy_dtype_promotion": "strict"}


def _with(settings: dict[str, str]) -> Iterator[None]:
    before = {name: getattr(jax.config, name) for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(scope="package")
def strict_promotion() -> Iterator[None]:
    """No silent broadcasting and no silent change of dtype."""
    yield from _with(RANKS | TYPES)


@pytest.fixture(scope="package")
def strict_ranks() -> Iterator[None]:
    """No silent broadcasting; Optax itself mixes dtypes."""
    yield from _with(RANKS)
=======
>>>>>>> tests
