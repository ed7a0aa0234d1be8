"""Replay of logs of simulated flights, whose policy, model and laps are known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadjax
from quadjax.core.resources import CONFIGS
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.formats import PLAIN
from quadjax.flights import Flight, Signal
from quadjax.flights.flight import motion_signals
from quadjax.log_states import disturbances_of
from quadjax.policy.file import Policy
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import write_residual
from tests.commands import run
from tests.fitting import racing_logs
from tests.fitting.flights import random_residual

from .test_report import PRETRAINED

POLICY = "e2e_nominal"


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


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A deterministic flight of a shipped policy without disturbances, and its log."""
    folder = tmp_path_factory.mktemp("replay")
    config = quadjax.load("e2e")
    policy = Policy.load(PRETRAINED / f"{POLICY}.npz")
    evaluation = quadjax.evaluate(policy, config, runs=1, laps=2, deterministic=True)
    _log(folder / "flight.csv", evaluation.flights[0], config.rules.time_step)
    return folder / "flight.csv", evaluation


@pytest.mark.slow
def test_the_policy_of_a_flight_commands_what_the_log_has(flown, tmp_path, capsys):
    log, evaluation = flown
    assert run("replay", log, "--policy", POLICY, "--json", tmp_path / "r.json",
               "--output", tmp_path, "--name", "out") == 0  # fmt: skip
    text = capsys.readouterr().out
    for word in ("laps: 2 of the track square4", "rpm_4", "fixed point: as", "position (m), model"):
        assert word in text
    found = json.loads((tmp_path / "r.json").read_text())
    for row in found["commands"]["each"]:
        assert row["correlation"] > 0.999 and row["rms_difference"] < 40.0
        assert row["fixed_error"] < 2.0
    np.testing.assert_allclose(found["lap_times"], evaluation.lap_times[0], atol=0.02)
    errors = found["prediction"]["rms_error"]
    assert found["prediction"]["drive"] == "commands"
    np.testing.assert_allclose(found["prediction"]["horizons"][1:], [0.1, 0.2, 0.5, 1.0])
    for name, most in {"position": 0.1, "velocity": 0.25, "attitude": 5.0, "rates": 0.3}.items():
        assert errors[name][2] < most < found["prediction"]["rms_unchanged"][name][2]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    for name in ("trajectory", "commands", "prediction"):
        assert {f"{name}.pdf", f"{name}.svg", f"{name}.png"} <= names
    assert json.loads((tmp_path / "out/replay.json").read_text()) == found


@pytest.mark.slow
def test_a_log_that_ends_before_its_last_gate_has_its_last_lap(flown, tmp_path):
    log, evaluation = flown
    lines = log.read_text().splitlines()
    (tmp_path / "cut.csv").write_text("\n".join(lines[:-3]) + "\n")
    drone = ("--vehicle", "bebop1.yaml", "--output", tmp_path, "--json", tmp_path / "r.json")
    assert run("replay", tmp_path / "cut.csv", *drone) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    np.testing.assert_allclose(found["lap_times"], evaluation.lap_times[0], atol=0.04)


@pytest.mark.slow
def test_a_fitted_vehicle_is_flown_with_its_residual(flown, tmp_path, capsys):
    """That of the fit's folder, unless another one or none is asked for; the table names it."""
    drone = tmp_path / "fit/vehicle.yaml"
    drone.parent.mkdir()
    drone.write_text((CONFIGS / "vehicles" / "bebop1.yaml").read_text())
    write_residual(
        tmp_path / "fit/residual.npz", random_residual(3, 1.0, (0.004, 0.004, 0.002)), {}
    )
    errors = []
    for options, residual in (((), "fit/residual.npz"), (("--residual", "none"), "none")):
        place = ("--output", tmp_path, "--name", f"out_{residual[0]}")
        options = (*options, *place, "--json", tmp_path / "r.json")
        assert run("replay", flown[0], "--vehicle", drone, *options) == 0
        assert f"{residual})" in capsys.readouterr().out
        errors.append(json.loads((tmp_path / "r.json").read_text())["prediction"]["rms_error"])
    assert errors[0]["rates"][1] > 1.5 * errors[1]["rates"][1]


@pytest.mark.slow
def test_a_policy_replayed_on_its_own_log_observes_the_estimated_disturbance(tmp_path, capsys):
    """On the plant, whose effects the policy's model lacks; with zeros the RMS is up to 500 rpm.

    The log has the laps that were flown.
    """
    own = ("standin", "--race", "e2e +residual +disturbance", "--policy", "e2e_adaptive")
    logs, out = tmp_path / "logs", ("--output", tmp_path, "--name", "out")
    assert run("logs", *own, "--flights", 1, "--laps", 2, "--output", logs) == 0
    (log,) = logs.glob("*.csv")
    assert run("replay", log, "--policy", "e2e_adaptive", "--logs", "paparazzi", *out) == 0
    assert "external moment and force: estimated from the log" in capsys.readouterr().out
    found = json.loads((tmp_path / "out/replay.json").read_text())
    np.testing.assert_allclose(found["lap_times"], [2.84, 2.41], atol=0.1)
    assert len(found["gate_times"]) == 8
    np.testing.assert_allclose(np.cumsum(found["lap_times"]), found["gate_times"][3::4], atol=1e-3)
    report = tmp_path / "report"
    assert run("evaluate", "e2e", "--flights", f"plant={logs}/*.csv", "--report", report) == 0
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
    found = disturbances_of(flight, motor.MODEL, VehicleParams(c))
    np.testing.assert_allclose(found["force_ext"][-1], [0.0, 0.0, -0.5], atol=1e-4)
    np.testing.assert_allclose(found["moment_ext"][-1], [2.0 * c.i_xx, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_another_drone_predicts_the_flight_worse(flown, tmp_path):
    """Also when its rotors turn at the logged speeds."""
    log, _ = flown
    errors = {}
    (tmp_path / "heavy.yaml").write_text(
        (PRETRAINED.parents[1] / "configs/vehicles/bebop1.yaml").read_text()
        .replace("k_w:", "k_w: 3.3e-8 #")
    )  # fmt: skip
    for vehicle in ("bebop1.yaml", tmp_path / "heavy.yaml"):
        out = ("--output", tmp_path, "--name", "out", "--overwrite")
        assert run("replay", log, "--vehicle", vehicle, "--drive", "speeds", *out) == 0
        found = json.loads((tmp_path / "out/replay.json").read_text())
        assert found["commands"] is None and found["prediction"]["drive"] == "speeds"
        errors[str(vehicle)] = found["prediction"]["rms_error"]["velocity"][2]
    right, wrong = errors.values()
    assert 3.0 * right < wrong


@pytest.mark.slow
def test_a_racing_quadcopter_without_rotor_speeds(tmp_path, capsys):
    path = PRETRAINED.parents[1] / "configs/vehicles/5inch.yaml"
    flight = racing_logs.fly(racing_logs.constants(path), seed=2, seconds=5.0)
    racing_logs.write_tii(tmp_path / "flight.csv", racing_logs.tii_columns(flight))
    out = ("--output", tmp_path, "--name", "out", "--overwrite")
    arguments = ("--vehicle", "5inch.yaml", "--logs", "tii", *out)
    assert run("replay", tmp_path / "flight.csv", *arguments) == 0
    found = json.loads((tmp_path / "out/replay.json").read_text())
    assert found["lap_times"] == [] and found["prediction"]["model"] == "racing"
    for name, most in {"position": 0.02, "velocity": 0.1, "attitude": 1.5}.items():
        assert found["prediction"]["rms_error"][name][2] < most
    # A policy of another model: what it observes of the motors is not known.
    assert run("replay", tmp_path / "flight.csv", *arguments, "--policy", "e2e_nominal") == 2
    assert "the model motor has rpm (4), which no column" in capsys.readouterr().err
    assert run("replay", tmp_path / "flight.csv", *arguments, "--policy", "indi") == 0
    text = capsys.readouterr().out
    assert "the policy's commands next to the log\n" in text and "thrust" in text
