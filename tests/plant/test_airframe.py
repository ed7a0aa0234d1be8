"""The airframe's measured deviations: polynomials of the motion, in float64, and their limits."""

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.airframe import airframe_force_moment, make_airframe
from quadjax.plant.config import AirframeConfig, PlantConfig, load_plant_config

CYBERZOO = load_plant_config("cyberzoo").airframe
SIGNS = {"roll": [1, -1, -1, 1], "pitch": [1, 1, -1, -1], "yaw": [-1, 1, -1, 1]}


def polynomials(config, rpm, velocity, rates):
    """Force along z and moment, term by term as they are written; float64."""
    values = {name: np.mean(np.multiply(signs, rpm)) / 1e4 for name, signs in SIGNS.items()}
    values |= {"w": np.mean(rpm) / 1e4, "v": np.hypot(*velocity[:2])}
    values |= dict(zip(("vx", "vy", "vz", "p", "q", "r"), [*velocity, *rates], strict=True))
    for name, (low, high) in config.limits.items():
        values[name] = np.clip(values[name], low, high)
    return [
        sum(
            number * np.prod([values[name] for name in term.split("*") if name != "1"])
            for term, number in getattr(config, output).items()
        )
        for output in ("force_z", "moment_x", "moment_y", "moment_z")
    ]


@pytest.mark.parametrize("speed", [1.0, 3.0])  # within the limits, and beyond them
def test_it_is_the_sum_of_its_terms(speed):
    random = np.random.default_rng(3)
    airframe = make_airframe(CYBERZOO)
    for _ in range(5):
        rpm, rates = random.uniform(7e3, 1.1e4, 4), random.uniform(-3.0, 3.0, 3)
        velocity = speed * random.uniform(-4.0, 4.0, 3)
        force, moment = airframe_force_moment(airframe, Rotors(*rpm), Vec3(*velocity), Vec3(*rates))
        found = [force, *moment.components()]
        expected = polynomials(CYBERZOO, rpm, velocity, rates)
        np.testing.assert_allclose(np.float64(found), expected, rtol=1e-4, atol=1e-6)


def test_left_and_right_are_alike():
    """Flown as in a mirror, the drone has the same force, and the moments of its mirror image.

    But for constant moments: rotors and balance of one drone.
    """
    airframe = make_airframe(CYBERZOO)
    rpm, v, w = np.array([9e3, 8e3, 1e4, 8.5e3]), np.array([2.0, 3.0, -1.0]), [0.5, -1.0, 0.7]

    def at(rpm, v, w):
        force, moment = airframe_force_moment(airframe, Rotors(*rpm), Vec3(*v), Vec3(*w))
        steady = [getattr(CYBERZOO, f"moment_{axis}").get("1", 0.0) for axis in "xyz"]
        return np.array([force, *(moment - Vec3(*steady)).components()], np.float64)

    mirrored = at(rpm[[1, 0, 3, 2]], v * [1, -1, 1], np.multiply(w, [-1, 1, -1]))
    np.testing.assert_allclose(mirrored, at(rpm, v, w) * [1, -1, 1, -1], rtol=1e-4, atol=1e-6)


def test_without_terms_there_is_none():
    assert make_airframe(AirframeConfig()) is None
    assert make_airframe(PlantConfig().airframe) is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("force_z", {"vx*vx*vx": 1.0}, "airframe.force_z has the term 'vx.vx.vx', allowed: 1, or"),
        ("moment_y", {"speed": 1.0}, "airframe.moment_y has the term 'speed', .*: 1, .* w, roll"),
        ("limits", {"speed": [0, 1]}, "airframe.limits has 'speed', allowed: w, roll"),
        ("limits", {"vx": [1, 0]}, "airframe.limits.vx"),
    ],
)
def test_what_is_no_term_is_refused(tmp_path, key, value, message):
    path = tmp_path / "own.yaml"
    path.write_text(f"airframe: {{{key}: {value}}}\n".replace("'", '"'))
    with pytest.raises(InputError, match=message):
        load_plant_config(path)


def test_the_variables_limits_are_those_of_the_flights():
    airframe = make_airframe(CYBERZOO)
    fast, limit = (
        airframe_force_moment(
            airframe, Rotors(*4 * [9000.0]), Vec3(0.0, y, 0.0), Vec3(*3 * [jnp.float32(0.0)])
        )[0]
        for y in (20.0, 6.79)
    )
    assert float(fast) == pytest.approx(float(limit), rel=0.05)
