"""Timed laps, the rows made of them, and their tables."""

import dataclasses

import jax
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.evaluation import published, table
from quadjax.evaluation.rows import Row, describe_crashes, interval
from quadjax.flights.flight import distinct, fastest, recorded_flights
from quadjax.race.laps import Laps, fly_laps
from quadjax.vehicle.registry import MODELS
from tests.evaluation.support import flights, rate_race, script, scripted

LAPS = 2


def fly(**wishes: float):
    config, environment, params = rate_race()
    key = jax.random.key(0)
    return config, *fly_laps(
        environment, params, scripted, script(**wishes), key, LAPS, 2, trace=True
    )


@pytest.fixture(scope="module")
def flown():
    return fly()


def test_a_lap_ends_where_the_path_crosses_the_last_gate(flown):
    config, laps, trace = flown
    assert laps.finished == 2 and laps.crashes == ("", "") and laps.lap_times.shape == (2, LAPS)
    np.testing.assert_allclose(laps.totals, laps.seconds, atol=1e-4)
    flights = recorded_flights(trace, laps, 0.01, config.track.gates, MODELS["rate"])
    assert len(distinct(flights)) == 1  # nothing is random here
    flight, gate = fastest(flights), config.track.gates[-1]
    yaw = np.radians(gate.yaw_deg)
    relative = flight["position"] - np.array(gate.position)
    ahead = np.cos(yaw) * relative[:, 0] + np.sin(yaw) * relative[:, 1]
    side = -np.sin(yaw) * relative[:, 0] + np.cos(yaw) * relative[:, 1]
    near = (np.abs(side) < 0.5) & (np.abs(relative[:, 2]) < 0.5)
    crossed = (ahead[:-1] < 0) & (ahead[1:] >= 0) & near[1:]
    np.testing.assert_allclose(flight.time[1:][crossed], np.cumsum(laps.lap_times[0]), atol=1e-4)
    assert flight.time[-1] == pytest.approx(laps.totals[0], abs=1e-4)
    assert flight["actuators"].shape == (len(flight.time), 1)
    np.testing.assert_allclose(flight["position"][0], config.track.gates[-1].position)
    np.testing.assert_array_equal(flight.passages[:, 1], [0, 1, 2, 3] * LAPS)
    late = flight.lap_ends - flight.passages[3::4, 0]  # the race counts the first sample past it
    assert (late >= 0.0).all() and (late < 0.01).all()


def test_a_race_of_some_gates_ends_within_a_lap(flown):
    _, whole, _ = flown
    _, environment, params = rate_race()
    own, key = script(), jax.random.key(0)
    laps, _ = fly_laps(environment, params, scripted, own, key, runs=2, gates=5)
    assert laps.finished == 2 and laps.lap_times.shape == (2, 2) and laps.last_gates == 1
    np.testing.assert_array_equal(laps.lap_times[:, 0], whole.lap_times[:, 0])
    assert np.all(laps.lap_times[:, 1] < 0.5 * whole.lap_times[:, 1])
    assert laps.whole_laps.shape == (2, 1) and laps.to_json()["last_lap_gates"] == 1
    assert laps.time_limit == pytest.approx(whole.time_limit * 5 / 8)
    text = table.lap_table([Row("own", laps)]).format()
    assert "1 gate" in text and "lap 2" not in text and "lap 1" in text


@pytest.mark.parametrize(
    ("reason", "wishes"),
    [
        ("hit a gate", {"offset": 0.9}),
        ("hit the ground", {"thrust": 0.3}),
        ("out of bounds", {"speed": -6.0}),
        ("lost its attitude", {"pitch_rate": -3.0}),
        ("out of time", {"speed": 0.05}),
    ],
)
def test_every_early_end_has_its_reason(reason, wishes):
    _, laps, _ = fly(**wishes)
    assert laps.crashes == (reason, reason)
    assert laps.finished == 0 and np.isnan(laps.totals).all()
    crash = laps.to_json()["crashes"][1]
    assert (crash["run"], crash["lap"], crash["reason"]) == (1, 1, reason)
    assert 0 < crash["seconds"] <= LAPS * 8.0
    assert describe_crashes(laps)[0].startswith(f"runs 1, 2: {reason} in lap 1")


def test_json_of_laps(flown):
    result = flown[1].to_json()
    assert set(result) == {"laps", "totals", "finished", "runs", "crashes"}
    assert result["finished"] == result["runs"] == 2 and result["crashes"] == []
    assert result["totals"][0] == pytest.approx(sum(result["laps"][0]), abs=1e-3)


def test_a_lap_table_names_policies_where_there_are_several_and_the_published_time():
    times = np.full((100, 6), 2.5)
    times[3, 4:] = np.nan
    crashes = tuple("hit a gate" if run == 3 else "" for run in range(100))
    laps = Laps(times, crashes, np.full(100, 15.0), 48.0)
    row = Row("mine", laps, "sampled, 100 runs", published=published.INDI)
    lines = table.lap_table([row]).format()
    assert all(word in lines for word in ("2.50", "lap 6", "15.00", "99/100"))
    assert "\npublished\n" in lines and "17.14" in lines and "15.75" not in lines
    assert "\nsampled, 100 runs " in lines and "mine" not in lines
    assert "\nsampled, 100 runs: run 4: hit a gate in lap 5 after 15.00 s" in lines
    other = dataclasses.replace(row, policy="other", condition="")
    lines = table.lap_table([row, other]).format()
    assert "\nmine, sampled, 100 runs " in lines and "\nother " in lines


def test_the_gap_is_that_of_the_fastest_lap_to_the_best_known_one():
    row = Row("mine", flights(5.0, 4.2, np.nan, before=1), best_known_lap=2.0)
    none = Row("none", flights(np.nan), best_known_lap=2.0)
    head, _, *lines = table.lap_table([row, none]).format("markdown").splitlines()
    assert [line.split(" | ")[-1] for line in (head, *lines[:2])] == ["gap |", "5.0% |", "- |"]
    text = table.condition_table([row, none], "", ("gap",)).format("markdown")
    assert "5.0%" in text and "gap" not in table.lap_table([Row("own", flights(5.0))]).format()


def test_many_early_ends_are_few_lines():
    times = np.full((50, 2), np.nan)
    times[40:] = 2.0
    reasons = ("hit a gate",) * 20 + ("hit the ground",) * 8 + ("out of time",) * 12 + ("",) * 10
    laps = Laps(times, reasons, np.linspace(1.0, 1.49, 50), 16.0)
    assert describe_crashes(laps) == [
        "20 runs: hit a gate in lap 1 after 1.00 to 1.19 s",
        "runs 21, 22, 23, 24, 25, 26, 27, 28: hit the ground in lap 1 after 1.20 to 1.27 s",
        "12 runs: out of time in lap 1 after 1.28 to 1.39 s",
    ]


def test_intervals_are_students():
    # Standard error sqrt(2.5 / 5), and 2.776 of them for 4 degrees of freedom.
    mean, width = interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0, np.nan]))
    assert mean == 3.0 and width == pytest.approx(2.776 * np.sqrt(0.5), rel=1e-3)
    assert np.isnan(interval(np.array([np.nan]))[0]) and np.isnan(interval(np.array([2.0]))[1])


def test_a_table_has_three_forms_and_a_drone_that_hovers_no_lap():
    still = Row("mine", flights(np.nan, np.nan, reason="out of time"))
    assert (still.crashed, still.without_lap, still.runs) == (0, 2, 2)
    text = table.policy_table([still], "crashed").format("markdown")
    assert "| mine | 0% and 100% without a lap / - |" in text
    assert text.endswith("crash / median of all laps but the first, s; of 2 flights.")
    assert still.to_json()["lap"] is None and still.to_json()["without_lap"] == 2
    rows = [Row("a_b & 100%", flights(3.0, 5.0)), Row("c", flights(4.0))]
    shown = table.lap_table([dataclasses.replace(row, published=published.INDI) for row in rows])
    assert "| a_b & 100% | 2.00 | 2.00 | - | - | - | - | 4.00 |" in shown.format("markdown")
    latex = shown.format("latex")
    assert r"a\_b \& 100\% & 2.00" in latex and latex.count(r"\midrule") == 2
    assert r"\multicolumn{10}{l}{published} \\" in latex
    with pytest.raises(InputError, match="format is 'html', allowed: text, markdown, latex"):
        shown.format("html")
