"""A short training that several tests begin with."""

import os

import pytest
from filelock import FileLock

from tests.commands import run
from tests.surface.short import short


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a run of ``e2e`` by its command, one for all workers: copy it to change it."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder = root / "trained"
    with FileLock(root / "trained.lock"):
        if not folder.exists():
            assert run("train", *short("e2e"), "--name", "trained", "--output", root) == 0
    return folder
