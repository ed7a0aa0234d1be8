"""What is derived from a vehicle file, and files written from data of an airframe."""

import math

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.vehicle import motor, rate
from quadjax.vehicle.airframe import Airframe
from quadjax.vehicle.summary import summarize, turns
from tests import reference as ref
from tests.commands import run

DATA = ("mass=0.6", "wheelbase=0.226", "propeller=0.127", "motor_kv=1900", "battery_volts=14.8")


def _turns(model, values):
    constants = model.make_constants({name: np.float32(x) for name, x in values.items()})
    return [np.asarray(x) for x in jax.jit(turns, static_argnums=0)(model, constants)]


def test_hover_thrust_and_turns_of_the_motor_model():
    found, c = summarize(motor.MODEL, ref.MOTOR), ref.MOTOR
    hover, ratio = math.sqrt(c["g"] / (4 * c["k_w"])), 4 * c["k_w"] * c["rpm_max"] ** 2 / c["g"]
    text = "\n".join(found.lines)
    assert f"{hover:.5g} of {c['rpm_min']:.5g} to {c['rpm_max']:.5g} rpm: " in text
    assert f"thrust-to-weight  {ratio:.2f}" in text and f"{1e3 * c['tau']:.3g} ms" in text
    most = 2 * c["k_p"] * (c["rpm_max"] ** 2 - c["rpm_min"] ** 2) / c["i_xx"]
    # The motors lag by 60 ms, so 0.1 s of command reach a part of the steady acceleration.
    accelerations, rates = _turns(motor.MODEL, c)
    assert 0.5 * most < accelerations[0] < most
    assert 0.02 * most < rates[0] < 0.1 * most
    assert found.warnings == []


def test_turns_of_the_rate_model():
    reached = ref.RATE["p_max"] * (1 - math.exp(-0.1 / ref.RATE["tau_rate"]))
    assert _turns(rate.MODEL, ref.RATE)[1] == pytest.approx(reached, rel=0.02)
    assert summarize(rate.MODEL, ref.RATE).warnings == []


def test_what_no_drone_has():
    for key, value, named in (
        ("k_w", 4.0e-6, "thrust-to-weight"),
        ("tau", 0.6, "tau"),
        ("k_p", 1.4e-12, "roll"),
    ):
        warnings = summarize(motor.MODEL, ref.MOTOR | {key: value}).warnings
        assert [text for text in warnings if text.startswith(named)], warnings


def test_the_bebop_from_its_airframe():
    """Every estimate is within a factor of two of the fitted constant."""
    frame = Airframe(
        mass=0.389, wheelbase=0.22, propeller=0.14, rpm_max=11000.0, thrust_to_weight=2.15
    )
    for name, value in frame.motor_constants().items():
        if value > 0 and name not in ("rpm_min", "tau"):
            assert 0.5 < value / ref.MOTOR[name] < 2.0, name


def test_a_file_from_data(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    assert run("show", path, "--write", "vehicle", *DATA, "thrust_to_weight=4") == 0
    printed = capsys.readouterr().out
    assert "thrust-to-weight  4.00" in printed and "warning" not in printed
    lines = path.read_text().splitlines()
    assert "mass: 0.6  # kg" in lines and "  tau: 0.03  # s" in lines
    config = load_config("e2e", [f"vehicle={path}"])  # needs no constants of the rate model
    assert config.vehicle.name == "mine" and config.vehicle.constants["tau"] == 0.03
    assert run("show", path, "--write", "vehicle", *DATA) == 2
    assert "already exists" in capsys.readouterr().err


def test_the_data_are_listed_with_their_defaults(capsys):
    assert run("show", "--write", "vehicle") == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["mass"] == "ready to fly, kg"
    assert lines["tau"] == "time constant of motor and controller, s (0.03)"
    assert run("show", "--write", "track") == 0
    assert "([3.0, 8.0])" in capsys.readouterr().out


def test_a_rate_model_alone(tmp_path, capsys):
    path = tmp_path / "rate.yaml"
    path.write_text("rate: " + str(ref.RATE).replace("'", "") + "\n")
    assert run("show", path) == 0
    assert "model rate" in capsys.readouterr().out
    assert load_config("indi", [f"vehicle={path}"]).vehicle.models == {}
