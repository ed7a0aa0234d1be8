"""Flights of every kind of source."""

import json

import numpy as np
import pytest

from quadjax.core.files import write_json
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation import sources
from quadjax.evaluation.sources import load_flights
from quadjax.fitting.flight_log import log_flight
from quadjax.flights.files import lap_times, load, save
from quadjax.view.data import make_title, page_record
from tests.commands import run
from tests.view.scenes import GATES, circle


def test_flights_best_laps_and_lap_times_make_one_page(tmp_path):
    best = circle("b", lap=2.6, laps=1).replace(source={"periodic": True, "note": "best"})
    save([circle("s", laps=3)], tmp_path / "states.npz")
    save([best], tmp_path / "best.npz")
    write_json(tmp_path / "times.json", {"laps": [[3.0, None], [3.1, 3.0], [2.9, 2.8]]})
    files = [tmp_path / name for name in ("states.npz", "best.npz", "times.json")]
    record = page_record("All", [flight for file in files for flight in load_flights(file)])
    assert [flight["name"] for flight in record["flights"]] == ["s", "b"]
    assert len(record["gates"]) == 4
    assert record["markers"] == [{"name": "times", "lap_ends": [2.9, 5.7]}]
    mine, best = record["flights"]
    assert mine["lap_ends"] == [3.0, 6.0, 9.0]
    titles = [signal.get("title") for signal in mine["signals"][3:]]
    assert titles == ["commanded rotor speed", "rotor speed", "body rates"]
    assert len(best["lap_ends"]) == 3 and best["note"] == "best, repeated 3 times"
    assert run("view", *files, "--name", "first", "--output", tmp_path / "all.npz") == 0
    again = load(tmp_path / "all.npz")
    assert [flight.name for flight in again] == ["first", "b", "times"]
    np.testing.assert_allclose(again[2].lap_times, lap_times("times", [2.9, 2.8]).lap_times)
    assert page_record("All", again)["markers"] == record["markers"]


def test_a_page_names_what_flies_and_tells_sources_apart(tmp_path):
    """The title: flights, drone and track, where these are known and the same."""
    one, other = (circle("e2e").replace(source={"race": f"{x}, ring"}) for x in ("Bebop", "5-inch"))
    for names, flights, wanted in (
        (("e2e",), [one], "e2e: Bebop, ring"),
        (("a", "b"), [one, one], "a, b: Bebop, ring"),
        (("a", "b"), [one, other], "a, b"),
        (("a", "b", "c", "d"), [one] * 4, "4 flights: Bebop, ring"),
        (("log",), [circle("log")], "log: hall"),
    ):
        named = [f.replace(name=name) for f, name in zip(flights, names, strict=True)]
        assert (
            make_title([*named, lap_times("paper", [1.0])], "hall" if "log" in names else "")
            == wanted
        )
    for folder in ("mine", "yours"):
        save([one], tmp_path / folder / "flown.npz")
    files = [tmp_path / folder / "flown.npz" for folder in ("mine", "yours")]
    assert run("view", *files, "--output", tmp_path / "page.json") == 0
    record = json.loads((tmp_path / "page.json").read_text())
    assert [each["name"] for each in record["flights"]] == [f"e2e ({file})" for file in files]
    assert record["title"].endswith(": Bebop, ring")
    assert run("view", files[0], files[0], "--output", tmp_path / "page.json") == 0
    record = json.loads((tmp_path / "page.json").read_text())
    assert [each["name"] for each in record["flights"]] == [f"e2e ({files[0]} {i})" for i in (1, 2)]


def test_a_log_is_a_flight_with_its_signals():
    flight = circle("log", laps=3)
    nothing = np.zeros((len(flight.time), 3))
    quantities = {"time": flight.time + 100.0, "rpm": nothing[:, [0]] + np.full(4, 9000.0)}
    quantities |= {"gyro": nothing, "acceleration": nothing, "flying": nothing[:, 0] + 1.0}
    quantities |= {"position": flight["position"], "quaternion": flight.rotation.as_quat()}
    velocity = flight.rotation.inv().apply(flight["velocity"])
    shown = log_flight("log.csv", quantities | {"body_velocity": velocity}).airborne()
    assert shown.time[0] == 0.0 and set(shown.signals) >= {"actuators", "specific_force", "flying"}
    np.testing.assert_allclose(shown["velocity"], flight["velocity"], atol=1e-9)
    lap_ends = shown.with_passages(GATES).lap_ends
    np.testing.assert_allclose(lap_ends, flight.passages[3::4, 0], atol=1e-9)


def test_bad_files_are_one_line(tmp_path, capsys):
    for name, content, says in (
        ("a.json", {"laps": [[None]]}, "expected laps: lists of times"),
        ("a.txt", {}, "suffix is '.txt', allowed: a run's folder, .npz, .csv, .json"),
        ("a.json", {"laps": [[3.0]]}, "no flight to show, only lap times"),
        ("", None, "expected the folder of a training run"),
    ):
        if content is not None:
            (tmp_path / name).write_text(json.dumps(content), encoding="utf-8")
        assert run("view", tmp_path / name, "--output", tmp_path / "out.html") == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1
        assert not (tmp_path / "out.html").exists()


def test_a_run_shows_its_newest_policy_while_it_trains(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(sources, "fly", lambda path, *_: shown.append(path.name) or [])
    for name in ("policy.npz", "policy_last.npz"):
        (tmp_path / name).write_bytes((PRETRAINED / "e2e.npz").read_bytes())
    load_flights(tmp_path)
    monkeypatch.setattr(sources, "is_finished", lambda folder: True)
    load_flights(tmp_path)
    assert shown == ["policy_last.npz", "policy.npz"]


@pytest.mark.slow
def test_policies_and_their_states_show_the_same_flight(tmp_path):
    states, page = tmp_path / "states.npz", tmp_path / "flights.npz"
    common = ("--laps", 1, "--runs", 1)
    more = ("--policy", "e2e", "--deterministic", "--states", states)
    assert run("evaluate", "e2e", *more, *common) == 0
    assert run("view", "e2e", states, "--race", "e2e", *common, "--output", page) == 0
    one, two = load(page)
    assert one.lap_ends == pytest.approx(two.lap_ends, abs=1e-9)
    np.testing.assert_allclose(one.passages, two.passages, atol=1e-9)
