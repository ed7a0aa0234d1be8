"""Both models against the double-precision reference, term by term and sign by sign."""

import jax
import numpy as np
import pytest

from quadjax.vehicle import motor, rate
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.registry import MODELS
from tests import reference as ref
from tests.convert import command_of, constants, residual_of, rows_of, state_of

COUNT = 4000
FORCES = ("k_x", "k_y", "k_z", "k_w", "k_h")
MOMENTS = ("k_p", "k_q", "k_pv", "k_qv", "k_r1", "k_r2", "k_rr")
# The derivative's columns that a term reaches: world acceleration, or one body acceleration.
REACHES = {
    **{name: (3, 4, 5) for name in FORCES},
    **{"k_p": (9,), "k_pv": (9,), "k_q": (10,), "k_qv": (10,)},
    **{"k_r1": (11,), "k_r2": (11,), "k_rr": (11,)},
}


@pytest.fixture(scope="module", autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def motor_rows():
    return ref.random_states("motor", COUNT), ref.random_commands("motor", COUNT)


@pytest.fixture(scope="module")
def motor_slope():
    """Rows of derivatives; one compilation for all sets of constants."""
    fly = jax.jit(jax.vmap(motor.MODEL.derivative, in_axes=(None, 0, 0)))

    def slope(values, rows, commands, residual=None):
        net = None if residual is None else residual_of(residual)
        params = VehicleParams(constants("motor", values), net)
        return rows_of(fly(params, state_of("motor", rows), command_of("motor", commands)))

    return slope


def agree(found, expected, tolerance=1e-11):
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-3)
    assert np.max(np.abs(found - expected) / scale) < tolerance


def quiet(**kept):
    """The Bebop's constants with every force and moment off but for those ``kept``."""
    return ref.MOTOR | dict.fromkeys(FORCES + MOMENTS, 0.0) | kept


def at_rest(**columns):
    """One level drone at rest with equal propellers, but for the columns given."""
    rows = np.zeros((1, 22))
    rows[:, ref.RPM] = 7000.0
    for column, value in columns.items():
        rows[0, int(column[1:])] = value
    return rows


HOLD = np.full((1, 4), 7000.0)


def test_motor_model(motor_rows, motor_slope):
    found = motor_slope(ref.MOTOR, *motor_rows)
    agree(found, ref.motor_derivative(ref.MOTOR, *motor_rows))
    np.testing.assert_array_equal(found[:, 16:], 0.0)


def test_each_constant_alone(motor_rows, motor_slope):
    still = motor_slope(quiet(), *motor_rows)
    for name in FORCES + MOMENTS:
        values = quiet(**{name: ref.MOTOR[name]})
        found = motor_slope(values, *motor_rows)
        agree(found, ref.motor_derivative(values, *motor_rows))
        change = np.abs(found - still).max(axis=0)
        assert set(np.flatnonzero(change > 1e-6)) == set(REACHES[name]), name
    for name in ("g", "i_xx", "i_yy", "i_zz", "tau"):
        values = ref.MOTOR | {name: 1.3 * ref.MOTOR[name]}
        agree(motor_slope(values, *motor_rows), ref.motor_derivative(values, *motor_rows))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_residual_networks(motor_rows, motor_slope, sign):
    residual = ref.random_residual(sign)
    found = motor_slope(ref.MOTOR, *motor_rows, residual)
    agree(found, ref.motor_derivative(ref.MOTOR, *motor_rows, residual))
    change = found - motor_slope(ref.MOTOR, *motor_rows)
    assert np.abs(change[:, 3:6]).max() > 0.5 and np.abs(change[:, 9:12]).max() > 5
    body = ref.rotate(np.swapaxes(ref.rotation(motor_rows[0][:, ref.EULER]), 1, 2), change[:, 3:6])
    np.testing.assert_allclose(body[:, :2], 0.0, atol=1e-12)


SIGNS = [
    ({"c3": 5.0}, HOLD, 3, -1),  # flying forward: drag backward
    ({"c4": 5.0}, HOLD, 4, -1),  # flying right: drag to the left
    ({"c3": 5.0}, HOLD, 10, +1),  # flying forward: nose up
    ({"c4": 5.0}, HOLD, 9, -1),  # flying right: right wing up
    ({"c12": 7100.0, "c15": 7100.0}, HOLD, 9, +1),  # left propellers faster: roll right
    ({"c12": 7100.0, "c13": 7100.0}, HOLD, 10, +1),  # front propellers faster: nose up
    ({"c13": 7100.0, "c15": 7100.0}, HOLD + [0, 100, 0, 100], 11, +1),  # yaw right
    ({}, np.array([[7000.0, 8000, 7000, 8000]]), 11, +1),  # spinning up those two as well
    ({"c11": 3.0}, HOLD, 11, -1),  # yaw damping
    ({"c12": 9000.0}, np.array([[9000.0, 7000, 7000, 7000]]), 5, -1),  # more thrust: up
]


def test_signs_by_hand(motor_slope):
    base = motor_slope(ref.MOTOR, at_rest(), HOLD)
    for columns, command, column, sign in SIGNS:
        change = motor_slope(ref.MOTOR, at_rest(**columns), command) - base
        assert sign * change[0, column] > 1e-4, (columns, column)


@pytest.fixture(scope="module")
def rate_slope():
    fly = jax.jit(jax.vmap(rate.MODEL.derivative, in_axes=(None, 0, 0)))

    def slope(values, rows, commands):
        params = VehicleParams(constants("rate", values))
        return rows_of(fly(params, state_of("rate", rows), command_of("rate", commands)))

    return slope


def test_rate_model(rate_slope):
    rows, commands = ref.random_states("rate", COUNT), ref.random_commands("rate", COUNT)
    plain = rate_slope(ref.RATE, rows, commands)
    agree(plain, ref.rate_derivative(ref.RATE, rows, commands))
    for name in ("g", "d_x", "d_y", "tau_rate", "tau_thrust"):
        values = ref.RATE | {name: 1.7 * ref.RATE[name]}
        found = rate_slope(values, rows, commands)
        agree(found, ref.rate_derivative(values, rows, commands))
        assert np.abs(found - plain).max() > 0.1


def test_every_constant_is_in_one_group():
    fixed = ("turning1", "turning2", "turning3", "turning4", "rotor_radius")
    for name, model in MODELS.items():
        grouped = [constant for names in model.groups.values() for constant in names]
        drawn = [constant for constant in model.constant_names if constant not in fixed]
        assert sorted(grouped) == sorted(drawn), name
