import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import butter, lfilter

from quadjax.core.errors import InputError
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.integrators import euler_step, rk4_step
from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle import estimator, motor
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import Measurement, VehicleParams
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState
from tests.estimator_reference import estimate

from .flights import random_residual

BEBOP = MotorConstants(
    g=9.81,
    i_xx=0.000906,
    i_yy=0.001242,
    i_zz=0.002054,
    k_x=1.07933887e-05,
    k_y=9.65250793e-06,
    k_z=2.7862899e-05,
    k_w=4.36301076e-08,
    k_h=0.0625501332,
    k_p=1.4119331e-09,
    k_q=1.21601884e-09,
    k_pv=-0.00797101848,
    k_qv=0.0129263739,
    k_r1=2.57035545e-06,
    k_r2=4.10923364e-07,
    k_rr=0.000812932607,
    tau=0.06,
    rpm_min=3000.0,
    rpm_max=11000.0,
)
MOMENT = np.array([0.02, -0.03, 0.008], np.float32)
FORCE = np.array([0.3, -0.2, -0.5], np.float32)


def _controlled(state, time):
    """Commands that keep the drone lively and upright: damped rates about a wandering target."""
    hover = motor.hover_rpm(BEBOP)
    target = Vec3(jnp.sin(2.1 * time), jnp.sin(1.7 * time + 1), jnp.sin(1.1 * time)) * 0.25
    turn = (target - state.euler) * 10.0 - state.rates * 2.5
    roll, pitch, yaw = 60.0 * turn.x, 60.0 * turn.y, 120.0 * turn.z
    lift = hover + 300.0 * jnp.sin(3.0 * time) + 500.0 * state.velocity.z
    mix = (roll + pitch - yaw, -roll + pitch + yaw, -roll - pitch - yaw, roll - pitch + yaw)
    return Rotors(*(jnp.clip(lift + part, 3000.0, 11000.0) for part in mix))


COUNT, SECONDS, ONSET = 3072, 6.0, 2.0  # of 6 s at 512 Hz; slower ones are cut
DRONE = VehicleParams(BEBOP, random_residual(1, 0.5, 0.005))


@functools.partial(jax.jit, static_argnames="euler")
def _fly(rate, substeps, euler):
    """A flight whose disturbances step from zero to their values at ``ONSET``, and estimates."""
    dt, integrator = 1.0 / (rate * substeps), euler_step if euler else rk4_step
    params = estimator.estimator_params(motor.MODEL, DRONE, rate, explicit_euler=euler)

    def step(state, index):
        time = index / rate
        on = jnp.where(time >= ONSET - 1e-6, 1.0, 0.0)
        state = state.replace(moment_ext=Vec3.of(MOMENT) * on, force_ext=Vec3.of(FORCE) * on)
        body_velocity = world_to_body(attitude(state.euler), state.velocity)
        steady = BodyState.steady(body_velocity, state.rates, state.actuators)
        force, _ = motor.MODEL.force_moment(DRONE, steady)
        measured = Measurement(
            gyro=state.rates,
            specific_force=force + state.force_ext,
            rpm=state.actuators,
            body_velocity=body_velocity,
        )
        command = _controlled(state, time)
        state = jax.lax.fori_loop(
            0,
            substeps,
            lambda _, s: integrator(lambda x: motor.MODEL.derivative(DRONE, x, command), s, dt),
            state,
        )
        return state, (measured, on)

    def follow(state, measurement):
        state, moment, force = estimator.update(params, state, measurement)
        return state, (moment.array(), force.array())

    zero = Vec3.zero()
    start = RigidBodyState(
        position=zero,
        velocity=Vec3.of(jnp.array([1.0, -0.5, 0.2])),
        euler=Vec3.of(jnp.array([0.1, -0.2, 0.3])),
        rates=Vec3.of(jnp.array([0.5, -0.4, 0.3])),
        actuators=Rotors.same(jnp.asarray(7000.0)),
        moment_ext=zero,
        force_ext=zero,
    )
    _, (measured, on) = jax.lax.scan(step, start, jnp.arange(COUNT))
    first = estimator.init(params, jax.tree.map(lambda x: x[0], measured))
    estimated = jax.lax.scan(follow, first, measured)[1]
    signals = {name: getattr(measured, name).array() for name in measured.__dataclass_fields__}
    return signals, on, *estimated


CASES = {
    "simulation 100 Hz": (100.0, 1, True),
    "on board 512 Hz": (512.0, 2, False),
    "continuous 100 Hz": (100.0, 8, False),
}


@pytest.fixture(scope="module", params=CASES, ids=list(CASES))
def flight(request):
    rate, substeps, euler = CASES[request.param]
    count = round(SECONDS * rate)
    signals, *rest = jax.tree.map(lambda x: np.asarray(x)[:count], _fly(rate, substeps, euler))
    return rate, euler, signals, *rest


def test_follows_a_step_as_the_filter_does_and_without_bias(flight):
    rate, euler, _, on, moment, force = flight
    b, a = butter(2, 8.0, fs=rate)
    step = lfilter(b, a, on)
    shifted = lfilter([0.0, 2 * b[0], 2 * b[0]] if euler else b, a, on)
    error_m = np.abs(moment - shifted[:, None] * MOMENT) / np.array([0.03, 0.03, 0.01])
    error_f = np.abs(force - step[:, None] * FORCE) / 0.5
    settled = slice(int(2.5 * rate), None)
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


def test_batches_and_differentiates():
    vehicle, ones = VehicleParams(BEBOP), np.ones(5, np.float32)
    three = Vec3(ones, ones, ones)
    batch = Measurement(three, three, Rotors.same(7000.0 * ones), three)

    @jax.jit
    def update(cutoff):
        params = estimator.estimator_params(motor.MODEL, vehicle, 100.0, cutoff)

        def total(measured):
            return estimator.update(params, estimator.init(params, measured), measured)[1:]

        return tuple(x.array() for x in jax.vmap(total)(batch))

    moment, force = update(8.0)
    assert moment.shape == force.shape == (5, 3)
    slope = jax.jit(jax.grad(lambda cutoff: update(cutoff)[1][0, 2]))(8.0)
    assert np.isfinite(slope)


def test_a_steady_start_is_no_disturbance():
    @jax.jit
    def estimated():
        params = estimator.estimator_params(motor.MODEL, VehicleParams(BEBOP), 100.0)
        still = Vec3.zero()
        rpm = Rotors.same(motor.hover_rpm(BEBOP))
        at_rest = Measurement(still, still.replace(z=jnp.asarray(-9.81)), rpm, still)
        found = estimator.update(params, estimator.init(params, at_rest), at_rest)
        return tuple(x.array() for x in found[1:])

    moment, force = estimated()
    np.testing.assert_allclose(moment, 0.0, atol=1e-7)
    np.testing.assert_allclose(force, 0.0, atol=1e-5)


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 50.0, 300.0])
def test_impossible_cutoff_is_refused(cutoff):
    with pytest.raises(InputError, match="cutoff"):
        estimator.estimator_params(motor.MODEL, VehicleParams(BEBOP), 100.0, cutoff)
