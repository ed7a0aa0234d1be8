"""Flights of every kind of source."""

import dataclasses
import json
import sys

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_json, write_npz
from quadjax.core.resources import PRETRAINED
from quadjax.dashboard.sources import Options, flight_of_log, scene_record
from quadjax.fitting.flight_log import FlightLog
from tests.commands import run
from tests.view.scenes import GATES, circle, scene


def arrays_of(flight, euler):
    n = len(flight.time)
    return {
        "time": flight.time,
        "position": flight.position,
        "velocity": flight.velocity,
        "euler": euler,
        "rates": np.zeros((n, 3)),
        "actuators": np.full((n, 4), 9000.0),
        "command": np.full((n, 4), 9100.0),
    }


def meta_of(kind, **more):
    gates = [gate.model_dump(mode="json") for gate in GATES]
    return {"format": kind, "vehicle": "motor", "track": gates, **more}


def write_states(path, flight, **more):
    own = arrays_of(flight, flight.attitude.as_euler("ZYX")[:, ::-1])
    whole = {key: value if key == "time" else value[None] for key, value in own.items()}
    whole["lap_times"] = np.diff(flight.lap_ends, prepend=0.0)[None]
    write_npz(path, whole, meta_of("quadjax-states/1", **more))


def write_limit(path, flight):
    own = arrays_of(flight, flight.attitude.as_euler("ZYX")[:, ::-1])
    own["leg_times"] = np.diff(flight.passages[:, 0], prepend=0.0)
    write_npz(path, own, meta_of("quadjax-limit/1", start="periodic"))


def test_states_best_laps_records_and_lap_times_make_one_page(tmp_path):
    states, best = tmp_path / "states.npz", tmp_path / "best.npz"
    write_states(states, circle("s", laps=3))
    write_limit(best, circle("b", lap=2.6, laps=1))
    write_json(tmp_path / "old.json", scene(circle("old", lap=3.3)).record())
    write_json(tmp_path / "times.json", {"laps": [[3.0, None], [3.1, 3.0], [2.9, 2.8]]})
    files = [states, best, tmp_path / "old.json", tmp_path / "times.json"]
    record = scene_record(files, ["mine"], "All", Options())
    assert [flight["name"] for flight in record["flights"]] == ["mine", "best", "old"]
    assert len(record["gates"]) == 4
    assert record["markers"] == [{"name": "times", "lap_ends": [2.9, 5.7]}]
    mine, best = record["flights"][:2]
    assert mine["lap_ends"] == [3.0, 6.0, 9.0]
    assert [signal.get("title") for signal in mine["signals"][3:]] == [
        "commanded rotor speed",
        "rotor speed",
        "body rates",
    ]
    assert len(best["lap_ends"]) == 3 and "repeated 3 times" in best["note"]


def test_flights_on_different_tracks_are_refused(tmp_path):
    states = tmp_path / "states.npz"
    write_states(states, circle("s"))
    other = scene(circle("old")).record()
    other["gates"][0]["position"][0] += 1.0
    write_json(tmp_path / "other.json", other)
    with pytest.raises(InputError, match="other.json: is on another track than .*states.npz"):
        scene_record([states, tmp_path / "other.json"], [], "Both", Options())


def log_of(flight):
    n = len(flight.time)
    return FlightLog(
        name="log",
        path="log.csv",
        time=flight.time + 100.0,
        rpm=np.full((n, 4), 9000.0),
        rpm_command=None,
        body_velocity=flight.attitude.inv().apply(flight.velocity),
        rates=np.zeros((n, 3)),
        specific_force=np.zeros((n, 3)),
        flying=np.ones(n, bool),
        position=flight.position,
        attitude=flight.attitude,
        columns={},
        rate_command=None,
        thrust_command=None,
    )


def test_a_log_shows_its_flight_and_laps():
    flight = circle("log", laps=3)
    shown = flight_of_log(log_of(flight), GATES, "log")
    assert shown.time[0] == 0.0
    np.testing.assert_allclose(shown.velocity, flight.velocity, atol=1e-9)
    np.testing.assert_allclose(shown.lap_ends, flight.passages[3::4, 0], atol=1e-9)


def test_a_log_that_ends_just_before_its_last_gate_has_its_last_lap():
    flight = circle("log", laps=3)
    end = int(np.searchsorted(flight.time, flight.passages[11, 0]))
    log = log_of(flight)
    names = ("time", "rpm", "body_velocity", "rates", "specific_force", "flying", "position")
    cut = {name: getattr(log, name)[:end] for name in names}
    log = dataclasses.replace(log, **cut, attitude=log.attitude[:end])
    shown = flight_of_log(log, GATES, "log")
    np.testing.assert_allclose(shown.lap_ends, flight.passages[3::4, 0], atol=0.02)
    np.testing.assert_allclose(shown.passages[-1, 2], flight.passages[-1, 2], atol=0.05)


def test_bad_files_are_one_line(tmp_path, capsys):
    for name, content, says in (
        ("a.json", {"format": "other"}, "format is 'other', expected quadjax-flights/1"),
        ("a.json", {"laps": [[None]]}, "expected format quadjax-flights/1, or laps"),
        ("a.txt", {}, "suffix is '.txt', allowed: a run's folder, .npz, .csv, .json"),
        ("a.json", {"laps": [[3.0]]}, "no flight to show, only lap times"),
    ):
        (tmp_path / name).write_text(json.dumps(content), encoding="utf-8")
        assert run("view", tmp_path / name, "--output", tmp_path / "out.html") == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1
        assert not (tmp_path / "out.html").exists()
    assert run("view", tmp_path) == 2
    assert "expected the folder of a training run" in capsys.readouterr().err
    assert run("view", "e2e", "--name", "a", "--name", "b") == 2
    assert "more names than flights" in capsys.readouterr().err


def test_code_that_a_file_names_is_not_imported(tmp_path):
    states = tmp_path / "states.npz"
    own = arrays_of(circle("s"), np.zeros((601, 3)))
    whole = {key: value if key == "time" else value[None] for key, value in own.items()}
    whole["lap_times"] = np.zeros((1, 0))
    write_npz(states, whole, meta_of("quadjax-states/1") | {"vehicle": "antigravity:MODEL"})
    (flight,) = scene_record([states], [], "One", Options())["flights"]
    assert [signal.get("title") for signal in flight["signals"][3:5]] == [
        "commanded values",
        "actuators",
    ]


def test_code_that_a_policy_file_names_is_not_imported(tmp_path, capsys):
    with np.load(PRETRAINED / "e2e_adaptive.npz") as file:
        arrays = {key: file[key] for key in file.files if key != "meta"}
        meta = json.loads(str(file["meta"]))
    for section, key, value in (
        ("rules", "extra", ["antigravity:RULE"]),
        ("reward", "terms", {"antigravity:TERM": 1.0}),
        ("vehicle", "model", "antigravity:MODEL"),
    ):
        config = {**meta["config"], section: {**meta["config"][section], key: value}}
        path = tmp_path / f"{section}.npz"
        write_npz(path, arrays, {**meta, "config": config})
        for command in (
            ("view", path, "--output", tmp_path / "out.html"),
            ("export", path, "--output", tmp_path / "out"),
            ("evaluate", "--policy", path),
            ("replay", tmp_path / "log.csv", "--policy", path),
        ):
            assert run(*command) == 2
            assert "code that this file names is not imported" in capsys.readouterr().err
    assert "antigravity" not in sys.modules


@pytest.mark.slow
def test_policies_and_their_states_show_the_same_flight(tmp_path):
    policy = PRETRAINED / "e2e_nominal.npz"
    common = ["--laps", "1", "--runs", "1"]
    states = tmp_path / "states.npz"
    more = ["--policy", policy, "--deterministic", "--states", states]
    assert run("evaluate", "e2e", *more, *common) == 0
    page = tmp_path / "flights.json"
    assert run("view", "e2e_nominal", states, "--race", "e2e", *common, "--output", page) == 0
    one, two = json.loads(page.read_text(encoding="utf-8"))["flights"]
    assert one["lap_ends"] == pytest.approx(two["lap_ends"], abs=1e-3)
    np.testing.assert_allclose(one["passages"], two["passages"], atol=2e-3)
    assert run("view", "e2e_adaptive", *common, "--output", page) == 0  # the race of its file
    (flight,) = json.loads(page.read_text(encoding="utf-8"))["flights"]
    assert len(flight["lap_ends"]) == 1
