"""The airframe's deviations against rigid-body mechanics in float64, rotor by rotor."""

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.airframe import airframe_force_moment, draw_airframe
from quadjax.plant.config import AirframeConfig, load_plant_config
from quadjax.plant.plant import filled, nominal_vehicle
from quadjax.vehicle.motor import nominal_force, nominal_moment

ROUGH = filled(load_plant_config("rough"))
PLACES = np.array([[1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])  # of rotors 1 to 4, in arms


def whole(constants, airframe, rpm, velocity, rates):
    """Specific force and moment of the four rotors, each pulling at its place; float64."""
    c, r, mass = constants, ROUGH.rotors, ROUGH.mass
    places = PLACES * [c.k_q / (mass * c.k_w), c.k_p / (mass * c.k_w), 0.0]
    center = np.array([airframe.offset_x, airframe.offset_y, 0.0], np.float64)
    level = np.array([*velocity[:2], 0.0])
    induced = mass * c.g / (8.0 * 1.225 * np.pi * r.radius**2)
    swept = level @ level / (level @ level + induced)
    hover = np.sqrt(c.g / (4 * c.k_w))
    force, moment = np.zeros(3), np.zeros(3)
    for i, place in enumerate(places):
        behind = (1 - place @ level / np.linalg.norm(place) / np.linalg.norm(level)) / 2
        faster = (rpm[i] ** 2 - hover**2) / c.rpm_max**2
        loss = airframe.rotor_loss[i] + airframe.speed_loss * faster
        thrust = c.k_w * rpm[i] ** 2 * (1 - loss - airframe.wake_loss * swept * behind)
        full = c.k_w * rpm[i] ** 2
        pull = np.array([full * airframe.tilt_x[i], full * airframe.tilt_y[i], -thrust], np.float64)
        force += pull
        moment += mass * np.cross(place - center, pull)
        # The model's torque, k_r1 w, is in ``rest``; that of the propeller is c w^2.
        linear, square = c.k_r1 * rpm[i], c.k_r1 / hover * rpm[i] ** 2
        moment[2] += (-1) ** (i + 1) * float(airframe.torque_curve) * (square - linear)
    missing = np.array([airframe.lift_loss, airframe.side_lift_loss], np.float64)
    force[2] -= c.k_h * ((1 - missing) @ level[:2] ** 2)
    # Drag, damping and the moments of velocity and speeds are the model's.
    still = c.replace(k_w=0.0, k_h=0.0, k_p=0.0, k_q=0.0)
    v, w, zero = Vec3(*velocity), Rotors(*rpm), Rotors(*np.zeros(4))
    rest = nominal_moment(still, w, zero, v, Vec3(*rates))
    drag = nominal_force(still, w, v)
    return force + drag.array(), moment + rest.array()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_is_the_sum_of_four_rotors(seed):
    random = np.random.default_rng(seed)
    constants = nominal_vehicle(ROUGH).motor
    airframe = draw_airframe(ROUGH.airframe, seed)
    rpm, velocity = random.uniform(4e3, 1.1e4, 4), random.uniform(-8.0, 8.0, 3)
    rates = random.uniform(-3.0, 3.0, 3)
    more = airframe_force_moment(
        airframe, ROUGH.rotors, constants, jnp.float32(ROUGH.mass), Rotors(*rpm), Vec3(*velocity)
    )
    model = (
        nominal_force(constants, Rotors(*rpm), Vec3(*velocity)),
        nominal_moment(
            constants, Rotors(*rpm), Rotors(*np.zeros(4)), Vec3(*velocity), Vec3(*rates)
        ),
    )
    expected = whole(constants, airframe, rpm, velocity, rates)
    for own, nominal, total in zip(more, model, expected, strict=True):
        np.testing.assert_allclose(
            np.asarray(own.array()) + nominal.array(), total, rtol=2e-5, atol=2e-6
        )


def test_a_seed_draws_one_drone_within_the_ranges():
    drawn = [draw_airframe(ROUGH.airframe, seed) for seed in range(1, 30)]
    again = draw_airframe(ROUGH.airframe, 5)
    assert again == drawn[4]
    losses = np.array([float(airframe.speed_loss) for airframe in drawn])
    low, high = ROUGH.airframe.speed_loss
    ends = low + np.array([0.3, 0.7]) * (high - low)
    assert low <= losses.min() < ends[0] and ends[1] < losses.max() <= high
    offsets = np.array([[airframe.offset_x, airframe.offset_y] for airframe in drawn])
    assert (np.abs(offsets) <= ROUGH.airframe.offset).all() and offsets.min() < 0 < offsets.max()
    assert draw_airframe(AirframeConfig(), 1) is None
