"""Vehicles of a config: files of the user, constants of rotors, and a saved config's models."""

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from tests import reference as ref
from tests.config.test_loading import refusal


def test_the_other_model_of_a_saved_config(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(load_config("e2e_ppo", ["vehicle.constants.tau=0.05"]).to_yaml())
    config = load_config(path, ["vehicle.model=rate"])
    assert config.vehicle.constants == ref.RATE
    assert config.vehicle.models == {"motor": ref.MOTOR | {"tau": 0.05}}
    assert config.vehicle.with_model("motor").constants["tau"] == 0.05
    with pytest.raises(InputError, match="no constants for boat"):
        config.vehicle.with_model("boat")


def test_a_short_form_keeps_the_other_overrides_of_its_section():
    overrides = ["vehicle.integrator=rk4", "vehicle=bebop1_authors", "vehicle.mismatch={k_w: 0.9}"]
    for order in (overrides, overrides[::-1]):
        vehicle = load_config("e2e", order).vehicle
        assert vehicle.integrator == "rk4" and vehicle.mismatch == {"k_w": 0.9}


ROTOR_FILE = """
model: racing
rotors: [rear_left, rear_right, front_right, front_left]
racing: {g: 9.81, k_w: 2.0e-6, k_x: 0, k_y: 0, k_p: [4.0e-6, 3.0e-6, 2.0e-6, 1.0e-6],
  k_p3: 3.0e-5, k_q: 5.0e-6, k_r: 6.0e-3, k_rd: 7.0e-3,
  turning: [ccw, cw, ccw, cw], w_min: 200, w_max: 4000, k: 0.5, tau: 0.03}
"""


def test_vehicle_file_with_a_model_and_constants_of_rotors(tmp_path):
    """Lists are in the file's order of rotors, constants in the project's."""
    (tmp_path / "mine.yaml").write_text(ROTOR_FILE)
    vehicle = load_config("e2e", [f"vehicle={tmp_path / 'mine.yaml'}"]).vehicle
    assert vehicle.model == "racing" and vehicle.name == "mine"
    found = {name: vehicle.constants[name] for name in vehicle.constants if name[-1] in "1234"}
    assert [found[f"k_p{i}"] for i in (1, 2, 3, 4)] == [1e-6, 2e-6, 3e-5, 4e-6]
    assert [found[f"turning{i}"] for i in (1, 2, 3, 4)] == [-1, 1, -1, 1]
    assert [found[f"k_q{i}"] for i in (1, 2, 3, 4)] == [5e-6] * 4
    over = [f"vehicle={tmp_path / 'mine.yaml'}", "vehicle.constants={k_q: 8.0e-6, k_q2: 9.0e-6}"]
    constants = load_config("e2e", over).vehicle.constants
    assert [constants[f"k_q{i}"] for i in (1, 2, 3, 4)] == [8e-6, 9e-6, 8e-6, 8e-6]


WRONG_ROTORS = """
rear_left, | middle, | rotors is ['middle', 'rear_right', 'front_right', 'front_left']
[4.0e-6, 3.0e-6, 2.0e-6, 1.0e-6] | [4, 3] | racing.k_p is [4, 3], allowed: one value for each rotor
[ccw, cw, ccw, cw] | [left, cw, ccw, cw] | allowed: cw or ccw for each
k_q: 5.0e-6 | k_q1: 5 | vehicle.constants.k_q2 is missing
model: racing | size: 3 | mine.yaml: size is 3; allowed: name, mass, width, fitted_speed, model, rot
""".strip().splitlines()


def test_errors_in_vehicle_files(tmp_path):
    for row in WRONG_ROTORS:
        old, new, message = row.split(" | ")
        assert old in ROTOR_FILE
        (tmp_path / "mine.yaml").write_text(ROTOR_FILE.replace(old, new))
        assert message in refusal("e2e", f"vehicle={tmp_path / 'mine.yaml'}")


def test_a_drone_without_a_rate_level_is_refused_where_body_rates_are_commanded():
    expected = "5inch.yaml has the model racing, the config the model rate"
    assert expected in refusal("indi_race", "vehicle=5inch")
    own = load_config("indi_race", ["vehicle=5inch", "vehicle.model=racing"])
    assert own.vehicle.model == "racing"
