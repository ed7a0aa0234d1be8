"""Vehicles of a config: files of the user, constants of rotors, and a saved config's models."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.vehicle.racing import Racing
from quadjax.vehicle.vehicle_file import read_vehicle, write_vehicle
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
[ccw, cw, ccw, cw] | [[cw], ccw, cw, ccw] | turning is [['cw'], 'ccw', 'cw', 'ccw'], allowed: cw or
[ccw, cw, ccw, cw] | [{a: 1}, ccw, cw, ccw] | allowed: cw or ccw for each
[4.0e-6, 3.0e-6, 2.0e-6, 1.0e-6] | [[4.0e-6], 3.0e-6, 2, 1] | k_p4 is [4e-06], allowed: a number
rear_left, | [rear_left], | rotors is [['rear_left'], 'rear_right', 'front_right', 'front_left']
[ccw, cw, ccw, cw] | [cw, cw, ccw, ccw] | mine.yaml: vehicle.constants: the rotors set only 3
k: 0.5 | k: 0.5, turning2: 7 | turning2 is 7.0, allowed: 1 (counter-clockwise seen from above) or -1
k_q: 5.0e-6 | k_q1: 5 | vehicle.constants.k_q2 is missing
model: racing | size: 3 | mine.yaml: size is 3; allowed: name, mass, width, fitted_speed, model, rot
""".strip().splitlines()


def test_errors_in_vehicle_files(tmp_path):
    for row in WRONG_ROTORS:
        old, new, message = row.split(" | ")
        assert old in ROTOR_FILE
        (tmp_path / "mine.yaml").write_text(ROTOR_FILE.replace(old, new))
        assert message in refusal("e2e", f"vehicle={tmp_path / 'mine.yaml'}")


PATTERNS = [  # of front left, front right, rear right, rear left; whether all four are set
    ("cw ccw cw ccw", True),
    ("ccw cw ccw cw", True),
    ("cw cw ccw ccw", False),  # as pitch
    ("ccw cw cw ccw", False),  # as roll
    ("cw ccw ccw cw", False),
    ("cw cw cw cw", False),  # as thrust
    ("ccw ccw ccw cw", False),  # no hover: without a moment there is no thrust
]


@pytest.mark.parametrize("name", ["5inch", "a2rl"])
@pytest.mark.parametrize(("turning", "allowed"), PATTERNS)
def test_rotors_that_set_thrust_roll_pitch_and_yaw(turning, allowed, name, tmp_path):
    """Also with the shipped drones' constants, which differ by 15% from rotor to rotor."""
    base = read_vehicle(name)
    model, signs = str(base.model), {"cw": -1.0, "ccw": 1.0}
    turns = {f"turning{i}": signs[word] for i, word in enumerate(turning.split(), 1)}
    path = tmp_path / "mine.yaml"
    write_vehicle(path, base.with_constants(model, base.models[model] | turns), "turned")
    if allowed:
        assert load_config("e2e", [f"vehicle={path}"]).vehicle.constants["turning1"]
        return
    expected = "mine.yaml: vehicle.constants: the rotors set only 3 of thrust, roll, pitch"
    assert expected in refusal("e2e", f"vehicle={path}")
    with pytest.raises(InputError, match="mine.yaml: .*: the rotors set only 3 of"):
        read_vehicle(str(path)).constants(model)  # of a fit
    over = [f"vehicle.constants.{key}={value}" for key, value in turns.items()]
    assert "overrides: vehicle.constants: the rotors" in refusal("e2e", f"vehicle={name}", *over)


def test_the_axes_of_any_number_of_rotors():
    """Six rotors that turn alternately, as PX4's for a lost motor, by halves, alike; and three."""
    angle = np.radians(np.arange(30, 390, 60))

    class Hexarotor(Racing):
        def allocation(self, c):
            return np.stack([np.ones(len(c)), -np.sin(angle), np.cos(angle), c])[:, : len(c)]

    for turning, count in (("+-+-+-", 4), ("++--+-", 4), ("+++---", 3), ("++++++", 3)):
        signs = np.array([{"+": 1.0, "-": -1.0}[x] for x in turning])
        assert (f"only {count} of" in Hexarotor().dependent_axes(signs)) == (count < 4), turning
    angle = angle[::2]
    assert "only 3 of" in Hexarotor().dependent_axes(np.array([1, -1, 1]))


def test_a_drone_without_a_rate_level_is_refused_where_body_rates_are_commanded():
    expected = "5inch.yaml has the model racing, the config the model rate"
    assert expected in refusal("indi_race", "vehicle=5inch")
    own = load_config("indi_race", ["vehicle=5inch", "vehicle.model=racing"])
    assert own.vehicle.model == "racing"
