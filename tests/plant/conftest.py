from collections.abc import Iterator

import pytest

from tests.promotion import RANKS, TYPES, settings


@pytest.fixture(scope="package", autouse=True)
def _strict() -> Iterator[None]:
    """Every test of this room runs without silent promotions."""
    with settings(RANKS | TYPES):
        yield
