"""Replay of logs of simulated flights, whose policy, model and laps are known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadjax
from quadjax.core.resources import CONFIGS
from quadjax.evaluation import report
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.formats import PLAIN
from quadjax.flights import Flight, Signal
from quadjax.flights.flight import motion_signals
from quadjax.replay import replay
from quadjax.replay.log_states import estimate_disturbances
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import write_residual
from tests.commands import run
from tests.fitting import racing_logs
from tests.fitting.flights import random_residual

POLICY = "e2e"


def _log(path, flight, step):
    """The plain columns of a recorded flight."""
    attitude = Rotation.from_euler("ZYX", flight["attitude"][:, ::-1])
    acceleration = np.gradient(flight["velocity"], step, axis=0) - [0.0, 0.0, 9.81]
    signals = {
        "time": step * np.arange(len(flight.time)),
        "rpm": flight["actuators"],
        "rpm_command": flight["command"],
        "gyro": flight["rates"],
        "acceleration": attitude.inv().apply(acceleration),
        "body_velocity": attitude.inv().apply(flight["velocity"]),
        "position": flight["position"],
        "euler": flight["attitude"],
    }
    columns = {}
    for quantity, values in signals.items():
        columns |= dict(zip(PLAIN[quantity], np.atleast_2d(values.T), strict=True))
    write_log(path, columns)


@pytest.fixture(autouse=True)
def without_figures(monkeypatch):
    for module in (replay, report):
        monkeypatch.setattr(module, "FORMATS", ())


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A deterministic flight of a shipped policy without disturbances, and its log."""
    folder = tmp_path_factory.mktemp("replay")
    config = quadjax.load("e2e")
    evaluation = quadjax.evaluate(POLICY, config, runs=1, laps=2, deterministic=True)
    _log(folder / "flight.csv", evaluation.flights[0], config.rules.time_step)
    return folder / "flight.csv", evaluation.lap_times[0]


def replayed(folder, log, *options):
    """What ``quadjax replay`` writes into its folder ``out``."""
    place = ("--output", folder, "--name", "out", "--overwrite")
    assert run("replay", log, *options, *place) == 0
    return json.loads((folder / "out/replay.json").read_text())


@pytest.mark.slow
def test_the_policy_of_a_flight_commands_what_the_log_has(flown, tmp_path, capsys, monkeypatch):
    monkeypatch.undo()  # with figures
    log, lap_times = flown
    found = replayed(tmp_path, log, "--policy", POLICY, "--json", tmp_path / "r.json")
    text = capsys.readouterr().out
    for word in ("laps: 2 of the track square4", "rpm_4", "fixed point: as", "position (m), model"):
        assert word in text
    for row in found["commands"]["each"]:
        assert row["correlation"] > 0.999 and row["rms_difference"] < 40.0
        assert row["fixed_error"] < 2.0
    np.testing.assert_allclose(found["lap_times"], lap_times, atol=0.02)
    errors = found["prediction"]["rms_error"]
    assert found["prediction"]["drive"] == "commands"
    np.testing.assert_allclose(found["prediction"]["horizons"][1:], [0.1, 0.2, 0.5, 1.0])
    for name, most in {"position": 0.1, "velocity": 0.25, "attitude": 5.0, "rates": 0.3}.items():
        assert errors[name][2] < most < found["prediction"]["rms_unchanged"][name][2]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    for name in ("trajectory", "commands", "prediction"):
        assert {f"{name}.pdf", f"{name}.svg", f"{name}.png"} <= names
    assert json.loads((tmp_path / "r.json").read_text()) == found


@pytest.mark.slow
def test_a_log_that_ends_before_its_last_gate_has_its_last_lap(flown, tmp_path):
    log, lap_times = flown
    lines = log.read_text().splitlines()
    (tmp_path / "cut.csv").write_text("\n".join(lines[:-3]) + "\n")
    found = replayed(tmp_path, tmp_path / "cut.csv", "--vehicle", "bebop1.yaml")
    np.testing.assert_allclose(found["lap_times"], lap_times, atol=0.04)


@pytest.mark.slow
def test_a_vehicle_is_flown_with_its_residual_and_another_drone_predicts_worse(
    flown, tmp_path, capsys
):
    """The residual of the fit's folder, unless another one or none is asked for."""
    log, _ = flown
    drone, heavy = tmp_path / "fit/vehicle.yaml", tmp_path / "heavy.yaml"
    drone.parent.mkdir()
    text = (CONFIGS / "vehicles/bebop1.yaml").read_text()
    drone.write_text(text)
    heavy.write_text(text.replace("k_w:", "k_w: 3.3e-8 #"))
    residual = random_residual(3, 1.0, (0.004, 0.004, 0.002))
    write_residual(tmp_path / "fit/residual.npz", residual, {})

    def errors(vehicle, *options):
        found = replayed(tmp_path, log, "--vehicle", vehicle, *options)
        assert found["commands"] is None
        assert found["prediction"]["drive"] == ("speeds" if "speeds" in options else "commands")
        return found["prediction"]["rms_error"]

    with_residual = errors(drone)["rates"][1]
    assert "fit/residual.npz)" in capsys.readouterr().out
    assert with_residual > 1.5 * errors(drone, "--residual", "none")["rates"][1]
    assert "none)" in capsys.readouterr().out
    right, wrong = (errors(x, "--drive", "speeds")["velocity"] for x in ("bebop1.yaml", heavy))
    assert 3.0 * right[2] < wrong[2]


@pytest.mark.slow
def test_a_policy_replayed_on_its_own_log_observes_the_estimated_disturbance(tmp_path, capsys):
    """On the plant, whose effects the policy's model lacks; with zeros the RMS is up to 500 rpm."""
    policy = ("--policy", "e2e_residual_disturbance")
    plant = ("standin", "--race", "e2e +residual +disturbance", *policy)
    logs = tmp_path / "logs"
    assert run("logs", *plant, "--flights", 1, "--laps", 2, "--output", logs) == 0
    (log,) = logs.glob("*.csv")
    found = replayed(tmp_path, log, *policy, "--logs", "paparazzi")
    assert "external moment and force: estimated from the log" in capsys.readouterr().out
    np.testing.assert_allclose(found["lap_times"], [2.84, 2.41], atol=0.1)
    assert len(found["gate_times"]) == 8
    np.testing.assert_allclose(np.cumsum(found["lap_times"]), found["gate_times"][3::4], atol=1e-3)
    report = tmp_path / "report"
    assert run("report", f"plant={logs}/*.csv", "--output", report) == 0
    (flight,) = json.loads((report / "report.json").read_text())["groups"]["plant"]
    np.testing.assert_allclose(flight["laps"], found["lap_times"], atol=2e-3)
    assert found["commands"]["disturbance"] == "estimated from the log"
    for row in found["commands"]["each"]:
        assert row["correlation"] > 0.98 and row["rms_difference"] < 150.0


def test_the_disturbances_of_a_log_are_those_of_the_onboard_estimator():
    """A hover with 0.5 m/s^2 more force, and a roll that is faster by 2 rad/s^2."""
    c = MotorConstants(**quadjax.load("e2e").vehicle.constants)
    count, step = 300, 0.005
    zero, time = np.zeros((count, 3)), step * np.arange(count)
    rates = zero + np.array([2.0, 0.0, 0.0]) * time[:, None]
    signals = motion_signals({"velocity": zero, "attitude": zero, "rates": rates})
    signals["specific_force"] = Signal(zero - [0.0, 0.0, c.g + 0.5], "m/s^2")
    signals["actuators"] = Signal(np.full((count, 4), float(motor.hover_rpm(c))), "rpm")
    flight = Flight("log", time, signals)
    found = estimate_disturbances(flight, motor.MODEL, VehicleParams(c))
    np.testing.assert_allclose(found["force_ext"][-1], [0.0, 0.0, -0.5], atol=1e-4)
    np.testing.assert_allclose(found["moment_ext"][-1], [2.0 * c.i_xx, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_a_racing_quadcopter_without_rotor_speeds(tmp_path, capsys):
    drone = racing_logs.constants(CONFIGS / "vehicles/5inch.yaml")
    log = tmp_path / "flight.csv"
    racing_logs.write_tii(log, racing_logs.tii_columns(racing_logs.fly(drone, 2, 5.0)))
    options = ("--vehicle", "5inch.yaml", "--logs", "tii")
    found = replayed(tmp_path, log, *options)
    assert found["lap_times"] == [] and found["prediction"]["model"] == "racing"
    for name, most in {"position": 0.02, "velocity": 0.1, "attitude": 1.5}.items():
        assert found["prediction"]["rms_error"][name][2] < most
    # A policy of another model: what it observes of the motors is not known.
    assert run("replay", log, *options, "--policy", "e2e", "--output", tmp_path) == 2
    assert "the model motor has rpm (4), which no column" in capsys.readouterr().err
    replayed(tmp_path, log, *options, "--policy", "indi")
    text = capsys.readouterr().out
    assert "the policy's commands next to the log\n" in text and "thrust" in text
