"""Settings of JAX: a silent broadcast or change of dtype is an error; quick compilation."""

import contextlib
from collections.abc import Iterator

import jax
import pytest

RANKS = {"jax_numpy_rank_promotion": "raise"}
TYPES = {"jax_numpy_dtype_promotion": "strict"}
# Compiled soon rather than well: half the time of the default.
QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


@contextlib.contextmanager
def settings(values: dict[str, str]) -> Iterator[None]:
    """JAX with ``values`` of its configuration, and as it was afterwards."""
    before = {name: getattr(jax.config, name) for name in values}
    for name, value in values.items():
        jax.config.update(name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def strict(values: dict[str, str]) -> object:
    """A fixture of a folder, all of whose tests run with ``values``."""

    @pytest.fixture(scope="package", autouse=True)
    def _strict() -> Iterator[None]:
        with settings(values):
            yield

    return _strict
