import pytest


@pytest.fixture(scope="package", autouse=True)
def _strict(strict_ranks):
    """Every test of this room runs without silent broadcasting."""
