"""Flights: slices, laps, resampling, and their files."""

import json

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.flights import Signal, fastest, load, save
from quadjax.flights.files import lap_times
from quadjax.flights.flight import distinct
from tests.flights.support import GATES, circle


def test_laps_end_with_the_last_gate():
    flight = circle()
    np.testing.assert_array_equal(flight.passages[:, 1], [0, 1, 0, 1])
    shift = 0.3 / np.pi
    np.testing.assert_allclose(flight.lap_ends, [2.0 - shift, 4.0 - shift], atol=1e-4)
    np.testing.assert_allclose(flight.lap_times, [2.0 - shift, 2.0], atol=1e-4)
    assert flight.total == pytest.approx(4.0 - shift, abs=1e-4)
    assert np.isnan(flight.replace(crash="hit a gate").total)
    assert list(np.unique(flight.target)) == [0, 1] and flight.target[0] == 0
    np.testing.assert_allclose(flight.speed, 3.0 * np.pi, atol=1e-9)
    np.testing.assert_allclose(flight.rotation.as_euler("ZYX")[:, 1], 0.2, atol=1e-12)


def test_a_slice_has_the_passages_and_laps_within_its_time():
    flight = circle().replace(crash="hit a gate")
    part = flight.slice(slice(100, 250), from_zero=True)
    assert part.time[0] == 0.0 and len(part.time) == 150 and part.crash is None
    np.testing.assert_allclose(part.passages[:, 0], flight.passages[1:2, 0] - 1.0)
    np.testing.assert_allclose(part.lap_ends, flight.lap_ends[:1] - 1.0)
    assert flight.slice(slice(100, None)).crash == "hit a gate"
    assert len(flight.opening(1.5).time) == 151 and len(flight.opening(99.0).time) == 401
    flying = Signal((np.abs(flight.time - 2.0) < 0.5)[:, None].astype(float))
    middle = flight.replace(signals=flight.signals | {"flying": flying}).airborne()
    assert len(middle.time) == 99 and middle.time[0] == 0.0
    never = flight.replace(signals=flight.signals | {"flying": Signal(0.0 * flying.values)})
    assert len(never.airborne().time) == 0


def test_the_fastest_has_the_most_laps_then_the_least_time():
    fast, slow, short = circle("fast", 1.8), circle("slow"), circle("short", 1.0, laps=1)
    assert fastest([short, slow, fast]).name == "fast"
    early = [circle(str(i)).replace(lap_ends=np.zeros(0)).opening(i) for i in (1, 2)]
    assert fastest(early).name == "2"
    assert [f.name for f in distinct([fast, slow, fast])] == ["fast", "slow"]


def test_a_sparse_flight_is_resampled_on_its_curve_and_a_dense_one_is_not():
    flight = circle(lap=4.0)
    thin = flight.map(lambda values: values[::20]).replace(time=flight.time[::20])
    dense = thin.resample()
    assert np.diff(dense.time).max() < 0.0101 and flight.resample() is flight
    np.testing.assert_allclose(np.linalg.norm(dense["position"][:, :2], axis=1), 3.0, atol=1e-3)
    turn = (dense.rotation.inv() * flight.rotation).magnitude()
    assert turn.max() < 5e-3  # also where the yaw jumps from pi to -pi


def test_a_periodic_lap_is_repeated():
    whole = circle(laps=3)
    lap = circle(laps=1).replace(source={"periodic": True, "note": "best"})
    three = lap.repeat(3)
    np.testing.assert_allclose(three.time, whole.time, atol=1e-9)
    np.testing.assert_allclose(three["position"], whole["position"], atol=1e-9)
    np.testing.assert_allclose(three.passages, whole.passages, atol=1e-6)
    assert three.source["note"] == "best, repeated 3 times" and whole.repeat(3) is whole


def test_commands_of_several_units_are_split():
    flight = circle(model="rate")
    rates, thrust = flight.signals["command"].by_unit()
    assert (rates.unit, thrust.unit) == ("rad/s", "m/s^2") and rates.values.shape == (401, 3)
    assert thrust.labels == ("thrust",) and thrust.values.shape == (401, 1)
    (motors,) = circle().signals["command"].by_unit()
    assert motors.unit == "rpm" and motors.labels[0] == "front left"


def test_a_file_has_flights_of_different_lengths_and_vehicles(tmp_path):
    flights = [circle("long"), circle("short", laps=1, model="rate").replace(crash="hit a gate")]
    save(flights, tmp_path / "a.npz", deterministic=True)
    again = load(tmp_path / "a.npz")
    for old, new in zip(flights, again, strict=True):
        assert (old.name, old.crash, old.gates) == (new.name, new.crash, new.gates)
        assert old.source == new.source and list(old.signals) == list(new.signals)
        for name in ("time", "passages", "lap_ends"):
            np.testing.assert_array_equal(getattr(old, name), getattr(new, name))
        for signal, read in zip(old.signals.values(), new.signals.values(), strict=True):
            np.testing.assert_array_equal(signal.values, read.values)
            assert (signal.unit, signal.labels) == (read.unit, read.labels)
    with np.load(tmp_path / "a.npz") as file:
        assert file["position"].shape == (2, 401, 3) and np.isnan(file["position"][1, -1]).all()
        meta = json.loads(str(file["meta"]))
    assert meta["deterministic"] is True and meta["format"] == "quadjax-flights/2"
    other = circle().with_passages(GATES[:1])
    for refused, name, says in (
        ([*flights, other], "b.npz", "of several tracks"),
        (flights, "b.txt", "allowed: .npz, .csv"),
    ):
        with pytest.raises(InputError, match=says):
            save(refused, tmp_path / name)


def test_a_table_has_a_line_for_each_time_and_units_in_its_header(tmp_path):
    save([circle(laps=1), circle(laps=2)], tmp_path / "a.csv")
    header, *lines = (tmp_path / "a.csv").read_text().splitlines()
    columns = header.split(",")
    assert columns[:3] == ["run", "time [s]", "position_x [m]"] and len(lines) == 201 + 401
    assert "command_front_left [rpm]" in columns and "attitude_yaw [rad]" in columns
    last = dict(zip(columns, map(float, lines[-1].split(",")), strict=True))
    assert (last["run"], last["time [s]"], last["position_z [m]"]) == (1, 4.0, -1.5)


def test_lap_times_without_a_trajectory_are_flights_without_samples(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"laps": [[3.0, None], [3.1, 3.0], [2.9, 2.8]]}))
    (times,) = load(path)
    np.testing.assert_allclose(times.lap_times, lap_times("", [2.9, 2.8]).lap_times)
    assert times.name == "a" and len(times.time) == 0
    path.write_text(json.dumps({"best_known": 2.0, "start": "periodic"}))
    assert load(path)[0].lap_times == [2.0]
    for damaged in ({"laps": [[None]]}, {"best_known": "x", "start": "periodic"}):
        path.write_text(json.dumps(damaged))
        with pytest.raises(InputError, match="expected laps: lists of times of complete runs"):
            load(path)


DAMAGE = {
    "signals": lambda arrays, flight: flight.update(
        signals={"../x": {"unit": "m", "labels": [], "size": 3}}
    ),
    "time": lambda arrays, flight: arrays.pop("time"),
    "shape": lambda arrays, flight: arrays.update(velocity=arrays["velocity"][:, :5]),
    "name": lambda arrays, flight: flight.clear(),
    "crash": lambda arrays, flight: flight.pop("crash"),
}


@pytest.mark.parametrize("change", DAMAGE)
def test_a_damaged_file_is_one_line(change, tmp_path):
    save([circle()], tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        arrays = {key: file[key] for key in file.files if key != "meta"}
        meta = json.loads(str(file["meta"]))
    DAMAGE[change](arrays, meta["flights"][0])
    write_npz(tmp_path / "b.npz", arrays, meta)
    with pytest.raises(InputError, match=r"^[^\n]*b\.npz[^\n]*$"):
        load(tmp_path / "b.npz")
