"""A damaged rotor and a shifted center of mass, against the equations in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.vectors import Rotors, Vec3
from quadjax.studies.adaptation import Damaged
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.rigid_body import RigidBodyState
from tests import reference as ref

RPM = np.array([7000.0, 7600.0, 8000.0, 7300.0])


def rates_and_force(model):
    """Angular acceleration and specific force of a drone at rest, and its propellers'."""
    params = VehicleParams(MotorConstants(**{k: jnp.float32(v) for k, v in ref.MOTOR.items()}))
    zero = Vec3.zero()
    rpm = Rotors(*(jnp.float32(x) for x in RPM))
    state = RigidBodyState(zero, zero, zero, zero, rpm, zero, zero)
    command = Rotors.same(jnp.float32(8000.0))
    after = model.derivative(params, state, command)
    force = model.specific_force(params, state)
    return [
        np.array([float(x) for x in v.components()]) for v in (after.rates, force, after.actuators)
    ]


@pytest.mark.parametrize("imbalance", [(0.0, 0.0), (1.2e-3, -0.7e-3)])
def test_weaker_rotors_and_a_shifted_mass(imbalance):
    c, factors = ref.MOTOR, np.array([0.85, 1.0, 0.9, 1.0])
    rates, force, spin = rates_and_force(
        Damaged(disturbed=True, rotors=tuple(factors), imbalance=imbalance)
    )
    squares, slowed = factors * RPM**2, np.sqrt(factors) * RPM
    np.testing.assert_allclose(spin, (8000.0 - RPM) / c["tau"], rtol=1e-4)
    np.testing.assert_allclose(force, [0.0, 0.0, -c["k_w"] * squares.sum()], rtol=1e-5)
    x, y = imbalance
    moment = [
        c["k_p"] * squares @ [1, -1, -1, 1] - y * force[2],
        c["k_q"] * squares @ [1, 1, -1, -1] + x * force[2],
        c["k_r1"] * slowed @ [-1, 1, -1, 1]
        + c["k_r2"] * (np.sqrt(factors) * spin) @ [-1, 1, -1, 1],
    ]
    inertia = [c["i_xx"], c["i_yy"], c["i_zz"]]
    np.testing.assert_allclose(rates, np.divide(moment, inertia), rtol=2e-3, atol=2e-3)


def test_without_damage_it_is_the_model():
    for own, model in zip(
        rates_and_force(Damaged(disturbed=True)), rates_and_force(motor.MODEL), strict=True
    ):
        np.testing.assert_allclose(own, model, rtol=1e-6)
