"""Sweeps, imported networks, pages in a browser, and racing policies on their autopilots."""

import csv
import json
import signal
from pathlib import Path

import numpy as np
import pytest

import quadjax
from tests.commands import run
from tests.policy.writers import c_source, forward, linear, relu
from tests.surface.short import OF_EACH, OF_LEARNER, short_config
from tests.surface.test_training import start, wait_for
from tests.view.browser import browser, opened, wait_until

fixtures = (browser,)
SWEEP = """
name: rates
config: e2e_ppo
overrides:
{overrides}
space:
  learner.learning_rate: {{log: [1.0e-4, 1.0e-2]}}
search: {{method: random}}
objective: {{seeds: 1, runs: 2}}
budget: {{trials: 3}}
executor: {{workers: 1}}
"""


def summaries(folder: Path) -> dict[Path, float]:
    """The summaries of the finished trainings of a sweep, with the times of their writing."""
    return {path: path.stat().st_mtime for path in folder.glob("trials/*/*/summary.json")}


@pytest.mark.slow
def test_a_killed_sweep_goes_on_and_runs_every_trial_once(tmp_path):
    words = (word.split("=", 1) for word in (*OF_EACH, *OF_LEARNER["ppo"]))
    overrides = "\n".join(f"  {key}: {value}" for key, value in words)
    (tmp_path / "rates.yaml").write_text(SWEEP.format(overrides=overrides))
    folder = tmp_path / "runs/rates"
    process = start(tmp_path, "sweep", "rates.yaml")
    wait_for(lambda: len(summaries(folder)) > 1, process)  # the first trial is complete
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    first = min(summaries(folder).items(), key=lambda item: item[1])
    assert len(summaries(folder)) < 3 and not (folder / "trials.csv").exists()
    process = start(tmp_path, "sweep", "rates.yaml")
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    with (folder / "trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["learner.learning_rate"] for row in rows}) == 3
    assert first in summaries(folder).items()  # it was not trained again


def test_a_network_in_c_is_imported_and_evaluated(tmp_path):
    arrays, file = linear((24, 8, 4)), tmp_path / "policy.npz"
    (tmp_path / "network.c").write_text(c_source(arrays))
    words = ("--activation", "relu", "--std", 0.1, "--output", file)
    assert run("import", "e2e", tmp_path / "network.c", *words) == 0
    x = np.random.default_rng(1).standard_normal((5, 24)).astype(np.float32)
    wanted = np.clip(forward(arrays, x, activation=relu), -1.0, 1.0)
    np.testing.assert_allclose(quadjax.Policy.load(file).mean(x), wanted, atol=1e-5)


@pytest.mark.slow
def test_the_flights_of_policies_and_a_run_are_shown_in_a_browser(
    trained, tmp_path, monkeypatch, browser
):
    monkeypatch.chdir(tmp_path)
    assert run("view", "e2e", trained, "--race", "e2e", "--laps", 1) == 0
    with opened(browser, (tmp_path / "flights.html").as_uri(), offline=True) as page:
        wait_until(page.page, "quadjax.viewer.clock.time > 0.2")
        assert len(page.state(0.1)["drones"]) == 2
        assert page.page.locator("tbody tr").first.inner_text().startswith("e2e")


WIDE = {"position": 64, "velocity": 128, "rates": 1024, "attitude": 4}


@pytest.fixture(scope="module")
def racing_policy(tmp_path_factory):
    """A policy that is trained for seconds: it need not finish its race."""
    folder = tmp_path_factory.mktemp("racing")
    return quadjax.train(short_config("e2e", "vehicle=5inch"), folder / "run").folder / "policy.npz"


@pytest.mark.slow
@pytest.mark.parametrize("target", ["cortex-a9", "indiflight"])
def test_a_racing_policy_is_exported_and_flown(target, racing_policy, tmp_path, monkeypatch):
    """And for INDIflight by the commands of docs/guide/autopilots.md, in tests/docs."""
    monkeypatch.chdir(tmp_path)
    ranges = [f"--range={name}={size}" for name, size in WIDE.items()]
    words = ("--output", "out", "--target", target, "--allow-unfinished", *ranges)
    assert run("export", racing_policy, *words) == 0
    assert run("sil", "out", "--simulator", "--laps", 1) == 0
    assert json.loads(Path("runs/sil/sil.json").read_text())["crashes"]
