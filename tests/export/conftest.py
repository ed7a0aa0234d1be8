"""Exported folders that the tests share, and an export without simulated flights."""

import pytest

from quadjax.export import flights
from tests.c_cache import compiled_once
from tests.export.support import export_of, random_rollouts

fixtures = (compiled_once,)


@pytest.fixture
def no_flights(monkeypatch):
    """Exports have random rows in place of the rows of flights, and no flight finishes."""
    monkeypatch.setattr(flights, "simulate", random_rollouts)


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """The folder of a made-up policy, with random states in place of those of flights."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "simulate", random_rollouts)
        return export_of(tmp_path_factory.mktemp("exported"))


@pytest.fixture(scope="session")
def flown(tmp_path_factory):
    """The folder of a made-up policy with the rows of its flights; for slow tests."""
    return export_of(tmp_path_factory.mktemp("flown"))
