import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter
from scipy.stats import norm

from quadjax.core.quaternion import of_euler
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import sensors
from quadjax.plant.sensor_config import (
    AccelerometerConfig,
    GyroConfig,
    MocapConfig,
    RpmConfig,
    SensorsConfig,
)
from quadjax.plant.sensors import GroundTruth
from tests.plant.support import NO_ERRORS, RATE, at

DRONES, SAMPLES = 200, 1000
NOISY = SensorsConfig(
    gyro=GyroConfig(noise=1e-3, bias=0.02, bias_walk=0.05, low_pass=98.0),
    accelerometer=AccelerometerConfig(noise=0.02, bias=0.3, bias_walk=0.0, low_pass=0.0),
    rpm=RpmConfig(noise=20.0, resolution=50.0),
    mocap=MocapConfig(rate=200.0, latency=0.02, dropout=0.2, dropout_frames=4.0),
)


@jax.jit
def _run(params, truths, drawn):
    """Measurements of drones along the last axis, and what the sensors carried."""
    each = jax.vmap(sensors.update, (None, -1, -1, -1), -1)

    def one(state, now):
        state, measured = each(params, state, *now)
        return state, (measured, state)

    first = at(truths, 0)
    start = jnp.concatenate([drawn[0], drawn[1]])[: sensors.START_DRAWS]
    state, _ = jax.vmap(sensors.init, (None, -1, -1), -1)(params, first, start)
    return state, jax.lax.scan(one, state, (truths, drawn))[1]


def _moving(samples, drones):
    """Everything moves: x = t, all else as sines of 98 Hz and slow turns."""
    time = np.arange(samples) / RATE

    def wide(signal):
        return np.broadcast_to(signal[:, None], (samples, drones)).astype(np.float32)

    zero, fast = wide(0.0 * time), wide(np.sin(2 * np.pi * 98.0 * time))
    rpm = Rotors(*(wide(7000.0 + 100.0 * i + 0.0 * time) for i in range(4)))
    return GroundTruth(
        Vec3(wide(time), zero, wide(-1.5 + 0 * time)),
        Vec3(wide(1.0 + 0.0 * time), zero, zero),
        Vec3(wide(0.3 * time), wide(0.1 * time), wide(-0.5 * time)),
        Vec3(fast, zero, wide(2.0 + 0.0 * time)),
        Vec3(fast, zero, wide(-9.81 + 0.0 * time)),
        rpm,
    )


def _measured(config, seed, scale=1.0):
    """Truths, the first state, measurements and states of sensors with draws of some scale."""
    truths, random = _moving(SAMPLES, DRONES), np.random.default_rng(seed)
    drawn = scale * random.standard_normal((SAMPLES, sensors.DRAWS, DRONES), np.float32)
    start, (measured, states) = _run(sensors.sensor_params(config, RATE), truths, drawn)
    return truths, start, measured, states


@pytest.fixture(scope="module")
def noisy():
    return _measured(NOISY, 3)


@pytest.fixture(scope="module")
def quiet():
    return _measured(NOISY, 0, 0.0)


def test_bias_starts_as_drawn_and_walks_as_its_density_says(noisy):
    _, start, _, states = noisy
    began = np.float64(start.gyro.bias.array())
    assert began.std() == pytest.approx(0.02, rel=0.1)
    walked = np.float64(states.gyro.bias.array()) - began  # (samples, drones, 3)
    for seconds in (0.5, 2.0):
        variance = walked[round(seconds * RATE) - 1].var()
        assert variance == pytest.approx(0.05**2 * seconds, rel=0.2)  # 600 walks: 6% of spread
    still = np.float64(states.accelerometer.bias.array())
    assert (still == still[:1]).all()
    assert still.std() == pytest.approx(0.3, rel=0.1)


def test_noise_of_a_sample_is_the_density_over_the_band(noisy):
    truths, _, measured, states = noisy
    noise = measured.accelerometer - truths.specific_force - states.accelerometer.bias
    assert np.float64(noise.y).std() == pytest.approx(0.02 * np.sqrt(RATE / 2), rel=0.01)
    # Through the low-pass: of white noise the share that its response lets pass.
    response = np.abs(freqz(*butter(2, 98.0, fs=RATE), worN=4096)[1])
    passed = 1e-3 * np.sqrt(RATE / 2 * (response**2).mean())
    steady = np.float64((measured.gyro.y - states.gyro.bias.y)[50:])
    assert steady.std() == pytest.approx(passed, rel=0.2)  # the bias's walk passes it late


def test_low_pass_is_the_units_butterworth(quiet):
    truths, _, measured, _ = quiet
    true, seen = np.float64(truths.rates.x[:, 0]), np.float64(measured.gyro.x[:, 0])
    np.testing.assert_allclose(seen, lfilter(*butter(2, 98.0, fs=RATE), true), atol=2e-5)
    assert np.abs(seen[500:]).max() == pytest.approx(np.sqrt(0.5), rel=0.01)  # -3 dB there
    np.testing.assert_allclose(measured.gyro.z, 2.0, atol=1e-5)  # steady from the start
    np.testing.assert_array_equal(measured.accelerometer.x, truths.specific_force.x)
    delay = sensors.low_pass_delay(98.0, RATE)
    slow = np.exp(1j * 2 * np.pi * 10.0 * delay)
    _, response = freqz(*butter(2, 98.0, fs=RATE), worN=[10.0], fs=RATE)
    assert abs(response[0] * slow - 1.0) < 1e-3  # at 10 Hz a pure delay, phase and size


def test_poses_come_at_their_rate_and_late(quiet):
    truths, _, measured, _ = quiet
    fresh = np.asarray(measured.fix.fresh[:, 0]) > 0
    arrivals = np.flatnonzero(fresh)
    assert set(np.diff(arrivals)) == {2, 3}  # 200 Hz in samples of 2 ms
    assert len(arrivals) == pytest.approx(SAMPLES / RATE * 200.0 - 0.02 * 200.0, abs=1)
    taken = np.float64(truths.position.x[arrivals - 10, 0])
    np.testing.assert_array_equal(measured.fix.position.x[arrivals, 0], taken)
    euler = at(at(truths.euler, arrivals - 10), (slice(None), 0))
    for got, true in zip(
        jax.tree.leaves(at(measured.fix.attitude, (arrivals, 0))),
        jax.tree.leaves(of_euler(euler)),
        strict=True,
    ):
        np.testing.assert_allclose(got, true, atol=2e-7)


def test_frames_are_lost_in_bursts(noisy):
    _, _, measured, states = noisy
    frames = SAMPLES / RATE * 200.0 - 0.02 * 200.0
    assert float(measured.fix.fresh.sum()) / (frames * DRONES) == pytest.approx(0.8, abs=0.015)
    gaps = [np.diff(np.flatnonzero(column)) for column in np.asarray(measured.fix.fresh).T]
    lost = np.concatenate(gaps) / RATE * 200.0 - 1.0
    assert lost[lost > 0.9].mean() == pytest.approx(4.0, rel=0.1)  # frames in a row


def test_pose_noise(noisy):
    truths, _, measured, _ = noisy
    there = np.asarray(measured.fix.fresh) > 0
    z = np.float64(measured.fix.position.z)[there] + 1.5
    assert z.std() == pytest.approx(1e-3, rel=0.02) and abs(z.mean()) < 5e-5


def test_propeller_speeds_are_noisy_and_coarse(noisy, quiet):
    for truths, _, measured, _ in (noisy, quiet):
        assert (np.asarray(measured.rpm.w2) % 50.0 == 0).all()
        assert np.float64(measured.rpm.w2 - truths.rpm.w2).mean() == pytest.approx(0.0, abs=0.2)
    # 7100 rpm is one of the steps: how often noise of 20 rpm leads to its neighbours, and beyond.
    steps = 50.0 * np.arange(-3, 4)
    share = norm.cdf((steps + 25.0) / 20.0) - norm.cdf((steps - 25.0) / 20.0)
    spread = np.float64(noisy[2].rpm.w2).std()
    assert spread == pytest.approx(np.sqrt((share * steps**2).sum()), rel=0.02)


def test_with_every_error_off_sensors_tell_the_truth():
    truths, _, measured, _ = _measured(NO_ERRORS, 5)
    pairs = (
        (measured.gyro, truths.rates),
        (measured.accelerometer, truths.specific_force),
        (measured.rpm, truths.rpm),
        (measured.fix.position, truths.position),
    )
    for seen, true in pairs:
        chex.assert_trees_all_equal(seen, true)
