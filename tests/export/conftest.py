"""Exported folders that the tests share, and an export without simulated flights."""

import pytest

from quadjax.export import flights
from tests.export.support import export_of, random_rollouts


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """The folder of a motor-level policy."""
    return export_of(tmp_path_factory.mktemp("motor"), "motor")


@pytest.fixture(scope="session")
def exported_rate(tmp_path_factory):
    """The folder of a rate-level policy."""
    return export_of(tmp_path_factory.mktemp("rate"), "rate")


@pytest.fixture
def no_flights(monkeypatch):
    """Exports have random rows in place of the rows of flights, and no flight finishes."""
    monkeypatch.setattr(flights, "simulate", random_rollouts)
