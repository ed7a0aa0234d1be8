"""What is derived from a vehicle file, and files written from data of an airframe."""

import math

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.vehicle import motor, racing, rate
from quadjax.vehicle.airframe import Airframe
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.summary import summarize, turns
from quadjax.vehicle.vehicle_file import read_vehicle
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
    found = frame.constants()
    for name, value in found["motor"].items():
        if value > 0 and name not in ("rpm_min", "tau"):
            assert 0.5 < value / ref.MOTOR[name] < 2.0, name
    for name in ("d_x", "d_y", "tau_rate", "tau_thrust", "r_max", "thrust_max"):
        assert 0.5 < found["rate"][name] / ref.RATE[name] < 2.0, name


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


SIX_INCH = "mass=0.9 propeller=0.1524 rpm_max=24000 tau=0.035 torque_ratio=0.012"
INERTIA = (0.0035, 0.004, 0.006)


def test_one_drone_in_three_models(tmp_path, capsys):
    """By the data: 14 N at 0.13 m; motors 1 and 4 at full speed and 2 and 3 idle roll the drone."""
    path = tmp_path / "mine.yaml"
    data = (*SIX_INCH.split(), "arm=0.13", "max_thrust=14", f"inertia={list(INERTIA)}")
    assert run("show", path, "--write", "vehicle", *data) == 0
    motors, racers, _ = capsys.readouterr().out.split("mine, model ")[1:]
    shown = [motors.split("rpm", 1)[1], racers.split("rad/s", 1)[1]]
    assert shown[0] == shown[1]  # percent of the hover, thrust, rates, lag
    assert "6.34" in motors and "45.3 rad/s within" in motors and "39.6 rad/s within" in motors
    of = {model: read_vehicle(str(path)).constants(model) for model in ("motor", "racing", "rate")}
    arm, most, idle = 0.13 / math.sqrt(2), 14.0, 14.0 * 0.12**2
    roll = 2 * arm * (most - idle) / INERTIA[0]
    c = of["racing"]
    assert c.k_p.w1 * 2 * (c.w_max**2 - c.w_min**2) == pytest.approx(roll, rel=1e-4)
    assert of["rate"].p_max == pytest.approx(0.5 * 0.035 * roll, rel=1e-4)
    assert of["rate"].thrust_max == pytest.approx((9.81 + 4 * most / 0.9) / 2, rel=1e-4)
    speeds, changes = np.random.default_rng(1).uniform(300, 2500, (2, 4))
    rpm, rates = (motor.Rotors(*(x * 30 / math.pi)) for x in (speeds, changes))
    still, inertia = motor.Vec3(0.0, 0.0, 0.0), np.array(INERTIA)
    moment = motor.nominal_moment(of["motor"], rpm, rates, still, still).array()
    spin = racing.nominal_spin(c, motor.Rotors(*speeds), motor.Rotors(*changes)).array()
    np.testing.assert_allclose(spin, moment / inertia, rtol=1e-4)
    velocity = motor.Vec3(3.0, -2.0, 0.0)
    force = motor.nominal_force(of["motor"], rpm, velocity).array()
    same = racing.nominal_force(c, motor.Rotors(*speeds), velocity).array()
    np.testing.assert_allclose(same, force, rtol=1e-4)
    for preset, model in (("e2e_race", "motor"), ("indi_race", "rate"), ("e2e_race", "racing")):
        config = load_config(preset, [f"vehicle={path}", f"vehicle.model={model}"])
        assert config.vehicle.constants == pytest.approx(values_of(of[model]))


SIDES = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
LENGTHS = """
wheelbase=0.26 | 0.0919 0.0919
arm=0.13 wheelbase=0.26 | 0.0919 0.0919
arm_x=0.0919 arm_y=0.0919 | 0.0919 0.0919
arm_x=0.08 arm_y=0.1 wheelbase=0.256 | 0.08 0.1
arm=0.13 arm_x=0.12 | 0.12 0.05
arm=0.13 arm_y=0.12 | 0.05 0.12
"""


@pytest.mark.parametrize("line", LENGTHS.strip().splitlines())
def test_the_arms_of_a_frame(line):
    data, arms = line.split(" | ")
    lengths = {key: float(value) for key, value in (x.split("=") for x in data.split())}
    frame = Airframe(mass=0.5, propeller=0.09, rpm_max=30000.0, **lengths)
    assert frame.arms == pytest.approx([float(x) for x in arms.split()], rel=1e-3)
    x, y = frame.arms  # tips of the propellers are within half of the width in every direction
    turn = np.linspace(0.0, 2.0 * np.pi, 721)
    tips = [[sx * x + 0.045 * np.cos(turn), sy * y + 0.045 * np.sin(turn)] for sx, sy in SIDES]
    assert np.hypot(*np.hstack(tips)).max() == pytest.approx(0.5 * frame.width, rel=1e-4)


REFUSED = """
wheelbase=0.26 arm_x=0.13 arm_y=0.13 | wheelbase is 0.26, but by arm_x and arm_y a motor is 0.1838
wheelbase=0.26 arm=0.26 | arm is 0.26, but by wheelbase a motor is 0.13 m
arm=0.13 arm_x=0.15 | arm_x is 0.15, allowed: below arm, 0.13
arm_x=0.1 | wheelbase is null, allowed: a number, or arm, or arm_x and arm_y
arm=0.1 | propeller is 0.1524, allowed: a diameter up to 0.1414 m, the distance of adjacent motors
arm=0.13 motor_kv=900 | rpm_max is 24000 and motor_kv is 900, allowed: one of them
arm=0.13 max_thrust=9 thrust_to_weight=4 | thrust_to_weight is 4 and max_thrust is 9, allowed: one
arm=0.13 inertia=0.1,0.2,0.3 | inertia is '0.1,0.2,0.3', allowed: a list: [0.1,0.2,0.3]
arm=0.13 propeller=6 | propeller is 6, allowed: less than or equal to 2 m
arm=0.13 max_thrust=2000 | max_thrust is 2000, allowed: less than or equal to 1000 N
arm=0.13 inertia=[0.1,0.1,0.9] | i_zz is 0.9, allowed: at most 0.2
arm=0.13 tau=0.001 | tau is 0.001, allowed: above 0.005 s
arm=0.13 maxthrust=9 | did you mean max_thrust?
"""


@pytest.mark.parametrize("line", REFUSED.strip().splitlines())
def test_data_that_contradict_or_have_no_effect(line, tmp_path, capsys):
    data, error = line.split(" | ")
    words = (*SIX_INCH.split(), *data.split())
    assert run("show", tmp_path / "mine.yaml", "--write", "vehicle", *words) == 2
    printed = capsys.readouterr().err.strip()
    assert error in printed and "\n" not in printed
    assert not list(tmp_path.iterdir())


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
