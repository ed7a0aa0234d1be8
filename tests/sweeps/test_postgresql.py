"""Two sweeps on one PostgreSQL database, on a server that the test itself starts."""

import os
import shutil
import socket
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from quadjax.sweeps import study as studies
from quadjax.sweeps.study import State, count, delete_study, open_study
from quadjax.sweeps.sweep import load_sweep
from tests.sweeps import stand_in
from tests.sweeps.stand_in import complete, open_small, run_small, sweep_file

pytestmark = pytest.mark.slow

PROGRAMS = os.pathsep.join(
    [*map(str, Path("/usr/lib/postgresql").glob("*/bin")), os.environ["PATH"]]
)


@pytest.fixture(scope="module")
def url():
    pytest.importorskip("psycopg", reason="the PostgreSQL driver is not installed")
    initdb, pg_ctl = (shutil.which(name, path=PROGRAMS) for name in ("initdb", "pg_ctl"))
    if initdb is None or pg_ctl is None:
        pytest.skip("no PostgreSQL server is installed (Debian: postgresql)")
    as_user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []  # never as root
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = Path(tempfile.mkdtemp(prefix="quadjax-postgresql-"))
    if as_user:
        shutil.chown(folder, "postgres")

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


def test_two_machines_never_run_the_same_trial(tmp_path, url):
    """Two sweeps with folders of their own on one database."""
    entries = {"storage": url, "budget": {"trials": 8}}
    found = [load_sweep(sweep_file(tmp_path / str(i), **entries)) for i in range(2)]

    def work(number: int) -> None:
        assert run_small(found[number], tmp_path / str(number), stand_in.measure)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, range(2)))
    study = open_study(found[0], tmp_path, run=False)
    assert sorted(t.user_attrs["index"] for t in complete(study)) == list(range(8))
    finished = [path.parent.name for path in tmp_path.glob("*/trials/*/finished")]
    assert sorted(finished) == [f"{index:04d}" for index in range(8)]


def test_a_trial_of_a_silent_machine_is_run_by_another(tmp_path, url, monkeypatch):
    monkeypatch.setattr(studies, "HEARTBEAT", 1)
    entries = {"storage": url, "name": "second", "budget": {"trials": 1}}
    sweep, directory, study = open_small(tmp_path, **entries)
    taken = study.ask()
    params = sweep.suggest(taken)
    study._storage.record_heartbeat(taken._trial_id)  # as the machine that dies now did
    again = open_study(sweep, directory)
    assert count(again)[State.RUNNING] == 1
    assert run_small(sweep, directory, stand_in.measure)
    assert [t.state for t in again.get_trials()] == [State.FAIL, State.COMPLETE]
    assert complete(again)[0].params == params
    delete_study(sweep, directory)
    assert count(open_study(sweep, directory)) == {State.WAITING: 1}
