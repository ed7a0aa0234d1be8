"""The onboard estimate of a disturbance, on flights of the float64 reference model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import butter, lfilter

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle import estimator, motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import Measurement, VehicleParams
from tests import reference as ref
from tests.estimator_reference import estimate

from .flights import as_reference, random_residual, runge_kutta

BEBOP = MotorConstants(**ref.MOTOR)
DRONE = VehicleParams(BEBOP, random_residual(1, 0.5, 0.005))
MOMENT, FORCE = np.array([0.02, -0.03, 0.008]), np.array([0.3, -0.2, -0.5])
SECONDS, ONSET = 1.6, 0.3
CASES = {  # rate, Hz; steps in a sample; whether they are explicit Euler steps
    "simulation 100 Hz": (100.0, 1, True),
    "on board 512 Hz": (512.0, 1, False),
    "continuous 100 Hz": (100.0, 4, False),
}


def controlled(x, time):
    """Commands that keep the drone lively and upright: damped rates about a wandering target."""
    target = 0.25 * np.array([np.sin(2.1 * time), np.sin(1.7 * time + 1), np.sin(1.1 * time)])
    turn = 10.0 * (target - x[0, ref.EULER]) - 2.5 * x[0, ref.RATES]
    roll, pitch, yaw = turn * [60.0, 60.0, 120.0]
    lift = float(motor.hover_rpm(BEBOP)) + 300.0 * np.sin(3.0 * time) + 500.0 * x[0, 5]
    mix = (roll + pitch - yaw, -roll + pitch + yaw, -roll - pitch - yaw, roll - pitch + yaw)
    return np.clip([[lift + part for part in mix]], 3000.0, 11000.0)


@pytest.fixture(scope="module", params=CASES, ids=list(CASES))
def flight(request):
    """A flight whose disturbances step from zero to their values at ``ONSET``, and estimates."""
    rate, substeps, euler = CASES[request.param]
    own, x, dt = as_reference(DRONE.residual), np.zeros((1, 22)), 1.0 / (rate * substeps)
    x[0, ref.V], x[0, ref.EULER], x[0, ref.RATES] = (
        [1, -0.5, 0.2],
        [0.1, -0.2, 0.3],
        [0.5, -0.4, 0.3],
    )
    x[0, ref.RPM], record = 7000.0, []
    on = (np.arange(round(SECONDS * rate)) / rate >= ONSET - 1e-6).astype(float)
    for index, active in enumerate(on):
        x[0, ref.MOMENT], x[0, ref.FORCE] = active * MOMENT, active * FORCE
        u = controlled(x, index / rate)

        def slope(x, u=u):
            return ref.motor_derivative(ref.MOTOR, x, u, own)

        k1, to_body = slope(x), np.swapaxes(ref.rotation(x[:, ref.EULER]), 1, 2)
        force = ref.rotate(to_body, k1[:, ref.V] - [0.0, 0.0, 9.81])[0]
        velocity = ref.rotate(to_body, x[:, ref.V])[0]
        record.append((x[0, ref.RATES].copy(), force, x[0, ref.RPM].copy(), velocity))
        for number in range(substeps):
            k1 = slope(x) if number else k1
            x = x + dt * k1 if euler else runge_kutta(slope, x, dt, k1)
    gyro, force, rpm, velocity = (np.float32(values) for values in zip(*record, strict=True))
    measured = Measurement(Vec3.of(gyro), Vec3.of(force), Rotors.of(rpm), Vec3.of(velocity))
    params = estimator.estimator_params(motor.MODEL, DRONE, rate, explicit_euler=euler)

    def follow(state, measurement):
        state, moment, force = estimator.update(params, state, measurement)
        return state, (moment.array(), force.array())

    first = estimator.init(params, jax.tree.map(lambda x: x[0], measured))
    estimated = jax.jit(lambda: jax.lax.scan(follow, first, measured)[1])()
    signals = {
        name: np.asarray(getattr(measured, name).array()) for name in measured.__dataclass_fields__
    }
    return rate, euler, signals, on, *map(np.asarray, estimated)


def test_follows_a_step_as_the_filter_does_and_without_bias(flight):
    rate, euler, _, on, moment, force = flight
    b, a = butter(2, 8.0, fs=rate)
    step = lfilter(b, a, on)
    shifted = lfilter([0.0, 2 * b[0], 2 * b[0]] if euler else b, a, on)
    error_m = np.abs(moment - shifted[:, None] * MOMENT) / np.array([0.03, 0.03, 0.01])
    error_f = np.abs(force - step[:, None] * FORCE) / 0.5
    settled = slice(int((ONSET + 0.5) * rate), None)
    assert np.abs((moment[settled].mean(0) - MOMENT) / [0.03, 0.03, 0.01]).max() < 0.02
    assert np.abs((force[settled].mean(0) - FORCE) / 0.5).max() < 0.02
    assert error_f.max() < 1e-3
    assert error_m.max() < (1e-4 if euler else 13.0 / rate)  # the step lies between two samples
    # Half of the step is reached no later than the filter itself reaches it.
    reached = int(np.argmax(step >= 0.5))
    slack = 1 if euler else 0  # there a moment moves the gyro only one sample later
    assert all(np.argmax(moment[:, i] / MOMENT[i] >= 0.5) <= reached + slack for i in range(3))
    assert all(np.argmax(force[:, i] / FORCE[i] >= 0.5) <= reached for i in range(3))


def test_jax_and_float64_reference_agree(flight):
    rate, euler, signals, _, moment, force = flight
    expected = estimate(DRONE, signals, rate, explicit_euler=euler)
    assert np.abs(moment - expected[0]).max() < 1e-5
    assert np.abs(force - expected[1]).max() < 1e-5


def test_a_steady_start_is_no_disturbance_and_the_estimate_has_derivatives():
    """Over two drones that turn about the yaw axis and then otherwise, by the filter's cutoff."""
    turn, none, ones = 2.0, Vec3.zero(), jnp.ones(2)
    apart = BEBOP.k_rr * turn / (4.0 * BEBOP.k_r1)  # rotors against the damping, rpm
    mean = jnp.sqrt(motor.hover_rpm(BEBOP) ** 2 - apart**2)
    rpm = Rotors(mean - apart, mean + apart, mean - apart, mean + apart)
    force = none.replace(z=jnp.float32(-9.81))
    rest = Measurement(none.replace(z=jnp.float32(turn)), force, rpm, none)
    rest = jax.tree.map(lambda x: x * ones, rest)
    after = rest.replace(gyro=Vec3(ones, -ones, ones), specific_force=Vec3(ones, ones, 0.0 * ones))

    def estimates(cutoff):
        """The first and the second estimate (2, 6) of each drone."""
        params = estimator.estimator_params(motor.MODEL, VehicleParams(BEBOP), 100.0, cutoff)

        def both(*measured):
            state, found = estimator.init(params, measured[0]), []
            for measurement in measured:
                state, moment, force = estimator.update(params, state, measurement)
                found.append(jnp.concatenate([moment.array(), force.array()]))
            return tuple(found)

        return jax.vmap(both)(rest, after)

    (first, second), (_, slope) = jax.jit(lambda x: jax.jvp(estimates, (x,), (1.0,)))(8.0)
    np.testing.assert_allclose(first, 0.0, atol=1e-5)
    assert (np.abs(second[:, :5]) > 1e-4).all()
    low, high = (np.float64(jax.jit(estimates)(x)[1]) for x in (7.5, 8.5))
    np.testing.assert_allclose(slope, high - low, rtol=0.02, atol=1e-5)
