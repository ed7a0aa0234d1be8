from collections.abc import Iterator

import pytest

from tests.promotion import RANKS, settings


@pytest.fixture(scope="package", autouse=True)
def _strict() -> Iterator[None]:
    """Every test of this room runs without silent broadcasting; Optax itself mixes dtypes."""
    with settings(RANKS):
        yield
