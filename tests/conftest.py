"""Eight host devices for the sharding tests; strict promotion for the rooms that keep to it."""

from collections.abc import Iterator

import jax
import pytest

jax.config.update("jax_num_cpu_devices", 8)  # before anything starts the backend

STRICT = {"jax_numpy_rank_promotion": "raise", "jax_numpy_dtype_promotion": "strict"}


@pytest.fixture(scope="package")
def strict_promotion() -> Iterator[None]:
    """No silent broadcasting and no silent change of dtype."""
    before = {name: getattr(jax.config, name) for name in STRICT}
    for name, value in STRICT.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
