"""Two workers on one PostgreSQL database, on a server that the test itself starts."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps import locks
from quadjax.sweeps.store import State, Store, delete_study
from tests.sweeps.support import open_store, value_of

PLACES = [str(p) for p in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]


def _find(name: str) -> str | None:
    return shutil.which(name, path=os.pathsep.join([*PLACES, os.environ.get("PATH", "")]))


def _user() -> str | None:
    """Whom the server runs as: never root."""
    if os.getuid() != 0:
        return pwd.getpwuid(os.getuid()).pw_name
    names = [entry.pw_name for entry in pwd.getpwall()]
    return next((name for name in ("postgres", "nobody") if name in names), None)


@pytest.fixture(scope="module")
def url():
    pytest.importorskip("psycopg", reason="the PostgreSQL driver is not installed")
    initdb, pg_ctl, user = _find("initdb"), _find("pg_ctl"), _user()
    if initdb is None or pg_ctl is None:
        pytest.skip("no PostgreSQL server is installed (Debian: postgresql)")
    if user is None or (os.getuid() == 0 and shutil.which("runuser") is None):
        pytest.skip("running as root, and there is nobody to run PostgreSQL as")
    as_user = ["runuser", "-u", user, "--"] if os.getuid() == 0 else []
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = Path(tempfile.mkdtemp(prefix="quadjax-postgresql-"))
    if as_user:
        shutil.chown(folder, user)

    def run(*command: str) -> None:
        # Output to a file: the server keeps what it is given for as long as it runs.
        with open(folder / "commands.log", "ab") as log:
            done = subprocess.run([*as_user, *command], cwd=folder, stdout=log, stderr=log)
        assert done.returncode == 0, (folder / "commands.log").read_text()

    data, options = str(folder / "data"), f"-p {port} -k {folder} -h 127.0.0.1 -c fsync=off"
    try:
        run(initdb, "-D", data, "-U", "quadjax", "-A", "trust", "-E", "UTF8", "--no-locale")
        run(pg_ctl, "-D", data, "-o", options, "-l", str(folder / "server.log"), "-w", "start")
        yield f"postgresql://quadjax@127.0.0.1:{port}/postgres"
        run(pg_ctl, "-D", data, "-m", "immediate", "-w", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_two_workers_never_run_the_same_trial(tmp_path, url):
    opened = [open_store(tmp_path / str(i), storage=url, budget={"trials": 12}) for i in range(2)]

    def work(own: Store) -> list[tuple]:
        taken = []
        while (claim := own.claim(locks.this_worker())) is not None:
            taken.append((claim.slot, tuple(claim.params.values())))
            own.finish(claim, value_of(claim.params))
        return taken

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(work, opened)
    slots = [slot for slot, _ in first + second]
    assert sorted(slots) == list(range(12)) and len({p for _, p in first + second}) == 12
    assert opened[0].counts() == opened[1].counts() and opened[0].counts().done == 12


@pytest.mark.slow
def test_a_dead_workers_trial_is_tried_once_more(tmp_path, url):
    entries = {"storage": url, "name": "second", "budget": {"trials": 1}}
    opened = open_store(tmp_path, **entries)
    process = subprocess.Popen(["true"])
    process.wait()
    gone = locks.Worker(**(locks.this_worker().to_json() | {"pid": process.pid, "began": "1"}))
    params = opened.claim(gone).params
    other = open_store(tmp_path / "other", **entries)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda own: own.tend(), [opened, other]))
    assert [t.state for t in other.trials()] == [State.FAIL, State.WAITING]
    again = other.claim(locks.this_worker())
    assert again.params == params and again.attempt == 1
    delete_study(opened.sweep, opened.directory)
    assert open_store(tmp_path, **entries).counts().waiting == 1


@pytest.mark.slow
def test_a_server_that_does_not_answer_is_one_line(tmp_path):
    pytest.importorskip("psycopg", reason="the PostgreSQL driver is not installed")
    with pytest.raises(InputError, match=r"storage: 127.0.0.1:9/none: ") as caught:
        open_store(tmp_path, storage="postgresql://me:secret@127.0.0.1:9/none")
    assert "secret" not in str(caught.value) and "\n" not in str(caught.value)
