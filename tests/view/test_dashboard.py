"""State of runs and sweeps, and their live pages in a real browser."""

import dataclasses
import json
import math
import shutil
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_csv, write_json
from quadjax.core.resources import PRETRAINED
from quadjax.dashboard.flyer import Flyer
from quadjax.dashboard.run_state import POINTS, TrainingRun
from quadjax.dashboard.sweep_state import JOURNAL, SweepRun
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from tests.commands import run
from tests.surface.short import short
from tests.view.browser import browser, wait_until

fixtures = (browser,)


def write_metrics(folder, count):
    rows = [(1000 * k, 0.5 * k, 8.0 - k / count if k > 3 else math.inf) for k in range(count)]
    write_csv(folder / "metrics.csv", [("steps", "seconds", "lap_total"), *rows])


def test_a_folder_that_does_not_exist_yet_has_a_state(tmp_path):
    state = TrainingRun(tmp_path / "later").state()
    assert state == {"finished": False, "total_steps": None}
    assert not (tmp_path / "later").exists()


def test_curves_of_a_run(tmp_path):
    write_metrics(tmp_path, 5000)
    write_json(tmp_path / "summary.json", {"finished": True})
    before = sorted((path.name, path.stat().st_mtime_ns) for path in tmp_path.iterdir())
    state = json.loads(json.dumps(TrainingRun(tmp_path).state(), allow_nan=False))
    columns = state["columns"]
    assert state["finished"]
    assert len(columns["steps"]) == POINTS
    assert (columns["steps"][0], columns["steps"][-1]) == (0, 4_999_000)
    assert columns["lap_total"][0] is None and columns["lap_total"][-1] == pytest.approx(7.0002)
    after = sorted((path.name, path.stat().st_mtime_ns) for path in tmp_path.iterdir())
    assert after == before


def test_trials_of_a_sweep_are_read_without_changing_its_journal(tmp_path):
    optuna = pytest.importorskip("optuna")
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / JOURNAL))
    study = optuna.create_study(storage=optuna.storages.JournalStorage(backend), study_name="s")
    for index, value in enumerate((5.0, 3.0)):
        study.enqueue_trial({"rate": 0.1 * (index + 1)}, user_attrs={"index": index})
        trial = study.ask({"rate": optuna.distributions.FloatDistribution(0.0, 1.0)})
        study.tell(trial, value)
    trial = study.ask({"rate": optuna.distributions.FloatDistribution(0.0, 1.0)})
    trial.report(4.0, 1)
    with open(tmp_path / JOURNAL, "ab") as stream:
        stream.write(b'{"op_code": 4, "half a li')  # as another process writes it
    before = (tmp_path / JOURNAL).read_bytes()
    state = SweepRun(tmp_path).state()
    assert [trial["value"] for trial in state["trials"]] == [5.0, 3.0, 4.0]
    assert [trial["state"] for trial in state["trials"]] == ["complete", "complete", "running"]
    assert state["best"] == 1
    assert state["trials"][1]["params"] == {"rate": pytest.approx(0.2)}
    assert (tmp_path / JOURNAL).read_bytes() == before


class Flipping:
    """A sweep whose best trial becomes another one as soon as its policy was asked for."""

    kind, name, finished = "sweep", "sweep", False

    def __init__(self, *policies):
        self.policies = list(policies)

    @property
    def policy(self):
        return self.policies.pop(0) if len(self.policies) > 1 else self.policies[0]


def test_a_policy_is_simulated_in_the_race_of_its_own_trial(tmp_path):
    first, second = (tmp_path / f"{name}.npz" for name in ("first", "second"))
    for path in (first, second):
        dataclasses.replace(Policy.load("e2e_nominal"), config={"nothing": 1}).save(path)
    flyer = Flyer(Flipping(first, second))
    for _ in range(6000):
        if flyer.error:
            break
        time.sleep(0.1)
    flyer.close()
    assert "first.npz: config" in flyer.error


def test_the_mean_action_flies_once_and_causes_are_of_the_sampled_flights(tmp_path, monkeypatch):
    shutil.copy(PRETRAINED / "e2e_nominal.npz", tmp_path / "policy.npz")
    seen = []

    def fly_policy(choices, params, policy, *, runs, deterministic, laps, trace):
        seen.append((runs, deterministic))
        sizes = {"position": 3, "velocity": 3, "euler": 3, "rates": 3, "actuators": 4, "command": 4}
        arrays = {name: np.zeros((3, size, runs)) for name, size in sizes.items()}
        crashes = ("" if deterministic else "hit a gate",) * runs
        flown = Laps(np.full((runs, laps), np.nan), crashes, np.full(runs, 0.02), 10.0)
        return flown, SimpleNamespace(**arrays, target=np.zeros((3, runs), int))

    monkeypatch.setattr("quadjax.policy.pilot.fly_policy", fly_policy)
    flyer = Flyer(Flipping(tmp_path / "policy.npz"))
    for _ in range(6000):
        if flyer.error or flyer.count:
            break
        time.sleep(0.1)
    flyer.close()
    assert not flyer.error and seen == [(1, True), (8, False)]
    assert flyer.causes == {"hit a gate": 8} and len(flyer.record["flights"]) == 1 + 3


def test_a_sweep_in_a_database_is_refused(tmp_path):
    with pytest.raises(InputError, match="no study.journal"):
        SweepRun(tmp_path)


def test_a_missing_folder_is_refused(tmp_path, capsys):
    assert run("watch", tmp_path / "nothing") == 2
    assert "no such folder" in capsys.readouterr().err


@pytest.fixture
def watched(tmp_path):
    """Start ``quadjax watch`` on a folder; returns the address of its page."""
    running = []

    def start(folder):
        command = [sys.executable, "-m", "quadjax", "watch", str(folder)]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return running[-1].stdout.readline().strip()

    yield start
    for process in running:
        process.terminate()
        assert process.wait(60) == 0


@pytest.mark.slow
def test_a_run_is_shown_while_it_trains(browser, watched, tmp_path):
    folder = tmp_path / "mine"
    assert run("train", *short("e2e_shac"), "--name", "mine", "--output", tmp_path) == 0
    page, errors = browser.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(watched(folder))
    wait_until(page, "document.querySelector('h1')?.textContent == 'mine'")
    assert "finished" in page.inner_text(".status")
    assert page.locator(".chart canvas:visible").count() >= 4
    wait_until(page, "Boolean(window.quadjax.viewer && quadjax.viewer.width > 0)")
    wait_until(page, "document.querySelectorAll('.causes li').length > 0")
    before = page.locator(".status").inner_text()
    write_metrics(folder, 20)
    wait_until(page, f"document.querySelector('.status').textContent != {json.dumps(before)}")
    assert not errors
    page.close()


@pytest.mark.slow
def test_train_watch_prints_an_address_that_answers(tmp_path):
    command = [sys.executable, "-m", "quadjax", "train", *short("e2e_shac")]
    more = ["--watch", "--output", str(tmp_path)]
    done = subprocess.run([*command, *more], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "watch: http://127.0.0.1:" in done.stderr
