"""The models of rigid bodies with four rotors against the double-precision reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core import quaternion
from quadjax.core.quaternion import Quaternion
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle import racing
from quadjax.vehicle.protocol import Motion, VehicleParams
from quadjax.vehicle.registry import MODELS
from quadjax.vehicle.rigid_body import RigidBodyState
from tests import reference as bebop
from tests.convert import command_of, constants
from tests.convert import state_of as bebop_state
from tests.promotion import QUICK
from tests.race.support import by_rows
from tests.vehicle import rigid_reference as ref

COUNT = 300
VEHICLES = {"5inch": ref.FIVE_INCH, "3inch": ref.THREE_INCH, "a2rl": ref.A2RL}
RANGES = {"5inch": (238, 3295), "3inch": (305, 4888), "a2rl": (342, 3100)}


@pytest.fixture(scope="module", autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@functools.cache
def vehicle_of(name):
    vehicle = load_config("e2e", (f"vehicle={name}", "track=figure8_tudelft")).vehicle
    return MODELS[vehicle.model], vehicle.constants


def params_of(name, **changed):
    model, values = vehicle_of(name)
    values = {key: np.float64(value) for key, value in (values | changed).items()}
    return VehicleParams(model.make_constants(values))


def state_of(rows):
    parts = (
        (Vec3, ref.P),
        (Vec3, ref.V),
        (Quaternion, ref.Q),
        (Vec3, ref.RATES),
        (Rotors, ref.ROTORS),
    )
    return RigidBodyState(
        *(kind(*(rows[..., i] for i in range(part.start, part.stop))) for kind, part in parts)
    )


def rows_of(state):
    flat = np.broadcast_arrays(*(np.asarray(leaf) for leaf in jax.tree.leaves(state)))
    return np.stack(flat, axis=-1)


@functools.cache
def _slope(model):
    return by_rows(model.derivative)


def slope_of(name, rows, command, **changed):
    params = params_of(name, **changed)
    commands = Rotors.of(np.asarray(command, float))
    return rows_of(_slope(vehicle_of(name)[0])(params, state_of(rows), commands))


def level(name, speed, **columns):
    rows = np.zeros((1, 17))
    rows[:, 6] = 1.0
    rows[:, ref.ROTORS] = speed
    for column, value in columns.items():
        rows[0, int(column[1:])] = value
    return rows


@pytest.mark.parametrize("name", VEHICLES)
def test_derivative(name):
    rows = ref.random_states(*RANGES[name], COUNT)
    command = np.random.default_rng(1).uniform(0.0, 1.0, (COUNT, 4))
    expected = ref.racing_derivative(VEHICLES[name], rows, command)
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-3)
    assert np.max(np.abs(slope_of(name, rows, command) - expected) / scale) < 1e-12


@pytest.mark.parametrize(
    ("name", "columns", "column", "expected"),
    [
        # One faster rotor of the 5-inch: thrust, roll, pitch and yaw. 2000^2 - 1000^2 = 3e6.
        ("5inch", {"c13": 2000.0}, 5, -2.49e-06 * 3e6),  # front left: up
        ("5inch", {"c13": 2000.0}, 10, 6.67e-05 * 3e6),  # to the right
        ("5inch", {"c13": 2000.0}, 11, 5.89e-05 * 3e6),  # nose up
        ("5inch", {"c13": 2000.0}, 12, -1.07e-02 * 1e3 + 1.97e-03 * 1e3 / 0.04),  # nose left
        ("5inch", {"c14": 2000.0}, 10, -6.61e-05 * 3e6),  # front right: to the left
        ("5inch", {"c14": 2000.0}, 12, 1.07e-02 * 1e3 - 1.97e-03 * 1e3 / 0.04),  # nose right
        ("5inch", {"c15": 2000.0}, 11, -5.28e-05 * 3e6),  # rear right: nose down
        ("5inch", {"c16": 2000.0}, 10, 6.36e-05 * 3e6),  # rear left: to the right
        ("5inch", {"c14": 2000.0}, 14, -1000.0 / 0.04),  # the rotor slows down
        ("a2rl", {"c3": -10.0}, 3, 5.37e-05 * 10 * 4000 + 0.0041 * 100),
        # Advance and angle of attack: R w is 48.5775 m/s.
        ("a2rl", {"c3": 10.0}, 5, -6.2 * 7.245 * np.arctan(100 / 48.5775**2)),
        ("a2rl", {"c5": 10.0}, 5, -6.2 * 3.14514 * np.arctan(10 / 48.5775)),  # sinking: more thrust
    ],
)
def test_signs_by_hand(name, columns, column, expected):
    """The change from level flight with all rotors at 1000 rad/s."""
    params = params_of(name).constants
    steady = racing.command_of(params, Rotors.same(np.float64(1000.0)))
    command = rows_of(steady)[None]
    change = slope_of(name, level(name, 1000.0, **columns), command) - slope_of(
        name, level(name, 1000.0), command
    )
    assert change[0, column] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", VEHICLES)
def test_hover_is_an_equilibrium(name):
    model, _ = vehicle_of(name)
    params = params_of(name)
    zero = Vec3.zero()
    motion = Motion(zero, zero, zero.replace(z=np.float64(0.7)), zero)
    state = jax.jit(model.hover, compiler_options=QUICK)(params.constants, motion)
    command = racing.command_of(params.constants, state.actuators)
    speeds = rows_of(racing.motor_map(params.constants, command))
    np.testing.assert_allclose(speeds, rows_of(state.actuators), rtol=1e-12)
    rows = (jax.tree.map(lambda leaf: np.asarray(leaf)[None], each) for each in (state, command))
    np.testing.assert_allclose(rows_of(_slope(model)(params, *rows)), 0.0, atol=1e-8)
    assert np.ptp(rows_of(state.actuators)) > 10


def test_drawn_curvature_of_the_motor_map_stays_valid():
    """A k above 1, as randomization draws it, is 1."""
    u = np.linspace(0, 1, 11)
    command = Rotors.same(jnp.asarray(u))
    found, linear = (
        rows_of(racing.motor_map(params_of("5inch", k=k).constants, command)) for k in (1.2, 1.0)
    )
    np.testing.assert_array_equal(found, linear)
    np.testing.assert_allclose(linear[:, 0], 238.49 + u * (3295.5 - 238.49))


def test_command_at_the_lowest_speed_has_a_finite_gradient():
    both = by_rows(lambda c, u: jax.value_and_grad(lambda u: motor_speed(c, u))(u))
    h = 1e-6
    speed, slope = both(params_of("a2rl").constants, np.array([0.0, 0.3, 0.3 + h, 0.3 - h]))
    assert 1e3 < slope[0] < 1e5
    assert slope[1] == pytest.approx((speed[2] - speed[3]) / (2 * h), rel=1e-6)


def motor_speed(constants, command):
    return racing.motor_map(constants, Rotors.same(command)).w1


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_models_of_euler_angles_with_a_quaternion(kind):
    """The same derivatives; those of the quaternion are the angles' at any regular attitude."""
    rows, commands = bebop.random_states(kind, COUNT), bebop.random_commands(kind, COUNT)
    plain, model = MODELS[kind], MODELS[kind].with_options(quaternion=True)
    params = VehicleParams(constants(kind, {"motor": bebop.MOTOR, "rate": bebop.RATE}[kind]))
    state, command = bebop_state(kind, rows), command_of(kind, commands)
    turned = state.replace(attitude=jax.jit(quaternion.of_euler)(state.euler))

    def slopes(params, state, turned, command):
        found = model.derivative(params, turned, command)
        angles = functools.partial(quaternion.to_euler, arctan2=arctan2)
        _, slope = jax.jvp(angles, (turned.attitude,), (found.attitude,))
        expected = plain.derivative(params, state, command)
        return expected, found.replace(attitude=slope), turned.euler

    expected, found, angles = by_rows(slopes)(params, state, turned, command)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9 * max(1.0, np.abs(theirs).max()))
    np.testing.assert_allclose(rows_of(angles), rows_of(state.euler), atol=1e-9)
    assert plain.pitch_limit < np.pi / 2 and model.pitch_limit == np.inf
