"""Paparazzi's inner loop: against its equations in float64, its response, what gives way first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import butter, lfilter, lfilter_zi

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import indi_simple
from quadjax.plant.config import IndiSimpleConfig, load_plant_config
from quadjax.plant.onboard import inner_params
from quadjax.vehicle.motor import hover_rpm, nominal_force, nominal_moment
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.vehicle_file import read_vehicle
from tests.plant.test_flight import DRONE

RATE = 512.0
PLANT = load_plant_config("cyberzoo")
BEBOP = read_vehicle("bebop1.yaml").motor
SIGNS = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [-1, 1, -1, 1]], float)
MIX = np.array([181, 181, 128]) / 256.0
STILL = Vec3(*np.float32([0.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def params():
    return inner_params(PLANT)


def vector(values):
    return Vec3(*(jnp.float32(x) for x in values))


def measured(gyro, thrust, rpm):
    return Measurement(vector(gyro), vector([0.0, 0.0, -thrust]), rpm, STILL)


def flown(params, gyro, thrust, commands):
    """The loop's motor commands (n, 4) for measured rates (n, 3), thrust (n,), commands (n, 4)."""
    hover = Rotors.same(jnp.float32(hover_rpm(BEBOP)))
    state = indi_simple.init(params, measured(gyro[0], thrust[0], hover))

    def one(state, now):
        gyro, thrust, command = now
        wanted = RateCommand(Vec3.of(command[:3]), command[3])
        sample = Measurement(Vec3.of(gyro), Vec3(0.0, 0.0, -thrust), hover, STILL)
        state, rotors = indi_simple.update(params, state, sample, wanted)
        return state, rotors.array()

    rows = jax.tree.map(jnp.float32, (gyro, thrust, commands))
    return np.float64(jax.jit(lambda: jax.lax.scan(one, state, rows)[1])())


def expected(gyro, thrust, commands):
    """The published equations, sample by sample, with SciPy's filter; float64."""
    b, a = butter(2, 8.0, fs=RATE)
    zi = lfilter_zi(b, a)
    p = PLANT.indi_simple
    effect, unit = np.array(p.effectiveness[:3]), (12000.0 - 3000.0) / 9600.0
    hover = (float(hover_rpm(BEBOP)) - 3000.0) / unit
    command = np.array([0.0, 0.0, 0.0, hover])
    actuators, memory = command.copy(), [zi * x for x in command]
    filtered, past = gyro[0], [zi * x for x in gyro[0]]
    z_thrust, last_yaw, result = zi * thrust[0], 0.0, []
    for rates, force, wanted in zip(gyro, thrust, commands, strict=True):
        actuators = actuators + (command - actuators) * (1 - np.exp(-1 / (p.actuator_lag * RATE)))
        now = np.empty(4)
        for i in range(4):
            (now[i],), memory[i] = lfilter(b, a, [actuators[i]], zi=memory[i])
        smooth = np.empty(3)
        for i in range(3):
            (smooth[i],), past[i] = lfilter(b, a, [rates[i]], zi=past[i])
        (lift,), z_thrust = lfilter(b, a, [force], zi=z_thrust)
        turn = np.array([*wanted[:2], np.clip(wanted[2], -p.yaw_rate, p.yaw_rate)]) - rates
        needed = p.gain * turn - (smooth - filtered) * RATE
        filtered = smooth
        change = np.append(needed / effect, p.thrust_gain * (wanted[3] - lift))
        g2 = p.effectiveness[3]
        change[2] = last_yaw = (needed[2] + g2 * last_yaw) / (effect[2] + g2)
        command = np.clip(now + change, [-9600] * 3 + [0], 9600)
        result.append(3000.0 + unit * (command[3] + (MIX * command[:3]) @ SIGNS))
    return np.array(result)


def test_it_is_the_published_loop(params):
    time = np.arange(300) / RATE
    gyro = 0.1 * np.stack([np.sin(20 * time), np.cos(15 * time), np.sin(9 * time)], axis=1)
    thrust = 9.81 + 0.5 * np.sin(30 * time)
    commands = np.tile([0.15, -0.1, 0.05, 10.0], (300, 1))
    found, right = flown(params, gyro, thrust, commands), expected(gyro, thrust, commands)
    assert np.ptp(right) > 1000.0 and right.min() > 3000.0 and right.max() < 12000.0
    np.testing.assert_allclose(found, right, atol=3.0)  # rpm


def test_a_drone_that_holds_its_command_keeps_its_rotors(params):
    commands = np.tile([0.0, 0.0, 0.0, 9.81], (200, 1))
    found = flown(params, np.zeros((200, 3)), np.full(200, 9.81), commands)
    np.testing.assert_allclose(found, float(hover_rpm(BEBOP)), atol=0.5)


def test_the_nominal_effectiveness_is_that_of_the_model():
    """Finite differences of the model in hover, of one unit of each command."""
    (roll, pitch, yaw, yaw_change), gain = indi_simple.nominal_effectiveness(BEBOP, 12000.0, RATE)
    hover, unit = float(hover_rpm(BEBOP)), (12000.0 - 3000.0) / 9600.0
    inertia = np.array([float(BEBOP.i_xx), float(BEBOP.i_yy), float(BEBOP.i_zz)])
    double = jax.tree.map(float, BEBOP)

    def turned(command, rate=0.0):
        step = unit * (MIX * command) @ SIGNS
        speeds, rates = Rotors(*(hover + step)), Rotors(*(rate * step))
        moment = nominal_moment(double, speeds, rates, Vec3(0.0, 0.0, 0.0), Vec3(0.0, 0.0, 0.0))
        return np.array(moment.components()) / inertia

    for axis, value in enumerate((roll, pitch, yaw)):
        assert turned(np.eye(3)[axis])[axis] == pytest.approx(value, rel=1e-3)
    assert (turned(np.eye(3)[2], RATE) - turned(np.eye(3)[2]))[2] == pytest.approx(yaw_change)
    up = nominal_force(double, Rotors(*4 * [hover + unit]), Vec3(0.0, 0.0, 0.0)).z
    assert -up - 9.81 == pytest.approx(1.0 / gain, rel=1e-3)
    # The airframe's numbers are of this drone: within the errors of both.
    published = PLANT.indi_simple.effectiveness
    assert published[:2] == pytest.approx((roll, pitch), rel=0.05)


def test_saturation_takes_from_yaw_first_then_from_thrust(params):
    def mixed(*command):
        rotors = indi_simple.mixed(params, Rotors(*(jnp.float32(x) for x in command)))
        return (np.float64(rotors.array()) - 3000.0) * 9600.0 / 9000.0

    def turn(motors):
        return SIGNS @ motors / 4.0 / MIX

    fits = mixed(500.0, -300.0, 200.0, 5000.0)
    np.testing.assert_allclose([*turn(fits), fits.mean()], [500, -300, 200, 5000], atol=0.5)
    yaw = mixed(4000.0, 0.0, 9000.0, 5000.0)
    np.testing.assert_allclose([turn(yaw)[0], yaw.mean()], [4000.0, 5000.0], atol=0.5)
    assert 0.0 < turn(yaw)[2] < 9000.0 and yaw.max() == pytest.approx(9600.0, abs=0.5)
    high = mixed(4000.0, 1000.0, 0.0, 9600.0)
    np.testing.assert_allclose(turn(high)[:2], [4000.0, 1000.0], atol=0.5)
    assert high.max() == pytest.approx(9600.0, abs=0.5) and high.mean() < 9600.0
    wide = mixed(9600.0, 9600.0, 0.0, 5000.0)  # more than the motors have: the direction stays
    assert turn(wide)[0] == pytest.approx(turn(wide)[1], rel=1e-4)
    assert wide.min() == pytest.approx(0.0, abs=0.5) and wide.max() == pytest.approx(9600.0, abs=1)


def test_without_priorities_each_motor_is_limited_by_itself(params):
    def mixed(command, saturation):
        rotors = Rotors(*(jnp.float32(x) for x in command))
        return np.float64(indi_simple.mixed(params, rotors, saturation).array())

    fits = [500.0, -300.0, 200.0, 5000.0]
    np.testing.assert_allclose(mixed(fits, "clip"), mixed(fits, None), atol=0.01)
    command = np.array([4000.0, 1000.0, 0.0, 9600.0])
    motors = (MIX * command[:3]) @ SIGNS + command[3]
    wanted = 3000.0 + 9000.0 / 9600.0 * np.clip(motors, 0.0, 9600.0)
    np.testing.assert_allclose(mixed(command, "clip"), wanted, atol=0.5)


def test_numbers_of_another_drone_are_refused():
    five = PLANT.replace(vehicle=str(DRONE), population={}, fitted_vehicle=None)
    with pytest.raises(InputError, match=r"indi_simple.effectiveness is .0.06, .* null takes"):
        inner_params(five)
    own = five.replace(indi_simple=IndiSimpleConfig())
    roll = indi_simple.nominal_effectiveness(
        read_vehicle(str(DRONE)).motor, own.motors.rpm_max, RATE
    )[0][0]
    assert float(inner_params(own).numbers.effectiveness[0]) == pytest.approx(roll, rel=1e-5)
