"""Mean and sampled flights of policies, tabulated."""

import json

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.evaluation.protocols import Protocols, protocol_table
from quadjax.evaluation.published import published_sampled
from quadjax.race.laps import Laps
from tests.commands import run
from tests.evaluation.support import random_policy


def laps(*totals: float) -> Laps:
    """Flights of one lap; NaN for one that crashes."""
    times = np.array(totals)[:, None]
    crashes = tuple("" if np.isfinite(x) else "hit a gate" for x in totals)
    return Laps(times, crashes, np.ones(len(totals)), 8.0)


def protocols(published=None) -> Protocols:
    mean = {"hover": laps(2.0, 2.0), "random": laps(2.5, np.nan)}
    sampled = {"hover": laps(2.0, 2.2), "random": laps(np.nan, np.nan)}
    return Protocols("mine", 0.05, mean, sampled, published)


def test_the_table_has_both_protocols_both_starts_and_the_flights_that_finish():
    text = protocol_table([protocols()])
    assert "| mine | 0.05 | 2.00 (2) | 2.10 (2) | 1.050 | 2.50 (1) | - (0) |" in text
    assert "of 2 flights" in text and "published" not in text
    assert protocols().to_json()["mean"]["random"] == {"time": 2.5, "finished": 1, "runs": 2}
    assert protocols().to_json()["sampled"]["random"]["time"] is None


@pytest.mark.parametrize(
    ("preset", "overrides", "time"),
    [
        ("indi_table1", [], 17.14),
        ("indi", ["vehicle=bebop1_authors"], 17.14),
        ("indi", [], None),  # thrust up to 15 m/s^2
        ("indi_table1", ["evaluate.laps=5"], None),
        ("e2e", [], None),  # no residual
        ("e2e", [], None),  # that of the stand-in plant
    ],
)
def test_a_published_time_is_only_next_to_its_equal(preset, overrides, time):
    row = published_sampled(load_config(preset, overrides))
    assert (row and row.total) == time
    text = protocol_table([protocols(row)])
    assert ("published INDI simulated, sampled |  |  | 17.14 |" in text) == (time is not None)


def test_the_published_time_is_below_the_policies_of_its_race():
    row = published_sampled(load_config("indi_table1"))
    lines = protocol_table([protocols(row), protocols(row), protocols()]).splitlines()
    assert ["published" in line for line in lines[2:6]] == [False, False, True, False]


@pytest.mark.slow
def test_the_command_flies_a_policy_in_its_own_race_and_in_another(tmp_path, capsys):
    random_policy().save(tmp_path / "one.npz")
    file = tmp_path / "a.json"
    arguments = ("--study", "protocols", "--runs", "2", "--json", file)
    assert (
        run("evaluate", "e2e", "evaluate.laps=1", "--policy", tmp_path / "one.npz", *arguments) == 0
    )
    assert "| one | " in capsys.readouterr().out
    found = json.loads(file.read_text())
    assert found["results"][0]["sampled"]["random"]["runs"] == 2
    assert found["provenance"]["config"]["name"] == "e2e"


def test_overrides_need_a_race(capsys):
    assert run("evaluate", "track=figure8", "--policy", "e2e") == 2
    assert "track=figure8: no such preset or file" in capsys.readouterr().err
