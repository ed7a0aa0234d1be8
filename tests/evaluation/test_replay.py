"""Replay of logs of simulated flights, whose policy, model and laps are known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadjax
from quadjax.fitting.columns import PLAIN
from quadjax.fitting.flight_log import write_log
from quadjax.policy.file import Policy
from tests.commands import run
from tests.fitting import racing_logs

from .test_report import PRETRAINED

POLICY = "e2e_nominal"


def _log(path, flight, step):
    """The plain columns of a recorded flight."""
    attitude = Rotation.from_euler("ZYX", flight.euler[:, ::-1])
    acceleration = np.gradient(flight.velocity, step, axis=0) - [0.0, 0.0, 9.81]
    signals = {
        "time": step * np.arange(len(flight.position)),
        "rpm": flight.actuators,
        "rpm_command": flight.command,
        "gyro": flight.rates,
        "acceleration": attitude.inv().apply(acceleration),
        "body_velocity": attitude.inv().apply(flight.velocity),
        "position": flight.position,
        "euler": flight.euler,
    }
    columns = {}
    for quantity, values in signals.items():
        columns |= dict(zip(PLAIN[quantity], np.atleast_2d(values.T), strict=True))
    write_log(path, columns)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A deterministic flight of a shipped policy without disturbances, and its log."""
    folder = tmp_path_factory.mktemp("replay")
    config = quadjax.load("e2e_shac")
    policy = Policy.load(PRETRAINED / f"{POLICY}.npz")
    evaluation = quadjax.evaluate(policy, config, runs=1, laps=2, deterministic=True)
    _log(folder / "flight.csv", evaluation.flights[0], evaluation.time_step)
    return folder / "flight.csv", evaluation


@pytest.mark.slow
def test_the_policy_of_a_flight_commands_what_the_log_has(flown, tmp_path, capsys):
    log, evaluation = flown
    assert run("replay", log, "--policy", POLICY, "--json", tmp_path / "r.json",
               "--output", tmp_path, "--name", "out") == 0  # fmt: skip
    text = capsys.readouterr().out
    for word in ("laps: 2 of the track square4", "rpm_4", "fixed point: as", "position  model"):
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
def test_another_drone_predicts_the_flight_worse(flown, tmp_path):
    """Also when its rotors turn at the logged speeds."""
    log, _ = flown
    errors = {}
    (tmp_path / "heavy.yaml").write_text(
        (PRETRAINED.parents[1] / "configs/vehicles/bebop1.yaml").read_text()
        .replace("k_w:", "k_w: 3.3e-8 #")
    )  # fmt: skip
    for vehicle in ("bebop1.yaml", tmp_path / "heavy.yaml"):
        out = ("--output", tmp_path, "--name", "out")
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
    arguments = ("--vehicle", "5inch.yaml", "--logs", "tii", "--output", tmp_path, "--name", "out")
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


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["LOG"], "--policy or --vehicle is required"),
        (["LOG", "--policy", "e2e", "--residual", "x.npz"], "--residual needs --vehicle"),
        (["LOG", "--policy", "e2e", "--drive", "wind"], "--drive"),
        (["nowhere.csv", "--policy", "e2e"], "nowhere.csv"),
        (["LOG", "--policy", "e2e", "--json", "x.txt"], "suffix is '.txt'"),
        (["LOG", "--policy", "e2e", "--logs", "nowhere"], "nowhere"),
        (["LOG", "--policy", "e2e"], "column 'rpm_1'"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, says, tmp_path, capsys):
    (tmp_path / "log.csv").write_text("t,p,q,r\n0,1,2,3\n")
    given = [tmp_path / "log.csv" if word == "LOG" else word for word in arguments]
    assert run("replay", *given, "--output", tmp_path, "--name", "out") == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and not (tmp_path / "out").exists()
