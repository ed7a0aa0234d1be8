"""A plant's physics: the training model with all off, and each effect as its source."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import effects, gusts, plant
from quadjax.plant.airframe import airframe_force_moment
from quadjax.plant.config import PlantConfig, load_plant_config, without_effects
from quadjax.plant.plant import build_plant, drawn_factors, filled
from quadjax.vehicle.residual import read_residual, residual_force_moment
from tests import reference as ref
from tests.convert import command_of, rows_of, state_of, vec3
from tests.plant import effects_reference as source
from tests.plant.support import OFF, only

COUNT = 200
DRONE = Path(__file__).parents[2] / "examples" / "03_drone.yaml"


def physics_of(rows: np.ndarray, charge: float = 1.0) -> plant.Physics:
    body = state_of("motor", rows.astype(np.float32))
    zero = np.zeros(len(rows), np.float32)
    return plant.Physics(body, Rotors.same(zero), zero + charge)


@functools.cache
def compiled_slope():
    return jax.jit(jax.vmap(plant.derivative, in_axes=(None, 0, 0, None)))


def slope(config: PlantConfig, rows: np.ndarray, commands: np.ndarray, **physics: object):
    """Derivatives (200,) of a plant; one row stands for all."""
    rows, commands = (np.broadcast_to(x, (COUNT, x.shape[1])) for x in (rows, commands))
    params = build_plant(config)
    state = physics_of(rows).replace(**physics)
    u = command_of("motor", commands.astype(np.float32))
    return compiled_slope()(params, state, u, Vec3(*np.zeros(3, np.float32)))


compiled_update = functools.cache(lambda: jax.jit(plant.update))
LATE = OFF.delay.replace(command=0.006)  # three samples: one program for all that flies
CALM = np.zeros(gusts.START_DRAWS, np.float32)


@pytest.fixture(scope="module")
def rows():
    drawn = ref.random_states("motor", COUNT)
    drawn[:, 2] = np.random.default_rng(5).uniform(-3.0, -0.05, COUNT)
    return drawn


@pytest.fixture(scope="module")
def commands():
    return ref.random_commands("motor", COUNT)


def agree(found, expected, tolerance=1e-6):
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-3)
    assert np.max(np.abs(np.asarray(found, np.float64) - expected) / scale) < tolerance


def test_with_all_off_its_derivative_is_the_training_models(rows, commands):
    found = slope(OFF, rows, commands)
    agree(rows_of(found.body), ref.motor_derivative(ref.MOTOR, rows, commands), 2e-6)
    for left in jax.tree.leaves((found.rpm_rate, found.charge)):
        assert not np.any(np.asarray(left))


def test_a_residual_is_an_effect():
    with_residual = PlantConfig(residual="standin_residual.npz")
    assert without_effects(with_residual) == without_effects(PlantConfig())


def test_the_plants_forces_have_its_airframe_and_its_residual(rows):
    """Each adds what its function gives, by the speeds that the drone's rotors act with."""
    zoo = load_plant_config("cyberzoo").replace(population={})
    physics = jax.tree.map(lambda x: x[0], physics_of(rows))
    air, still = Vec3(*np.float32([3.0, -2.0, 1.0])), Rotors.same(np.float32(0.0))
    residual = read_residual("standin_residual.npz")
    compiled = jax.jit(plant.forces)

    def added(params, without):
        pairs = zip(*(compiled(x, physics, still, air) for x in (params, without)), strict=True)
        return np.concatenate([(a - b).array() for a, b in pairs])

    for strength in (1.0, 0.5, 0.0):
        on = zoo.effects.replace(airframe_force=strength, airframe_moment=2.0 * strength)
        params = build_plant(zoo.replace(effects=on))
        rpm = physics.body.actuators * params.rotor_factor
        force, moment = airframe_force_moment(params.airframe, rpm, air, physics.body.rates)
        expected = strength * np.concatenate([[0.0, 0.0, force], 2.0 * moment.array()])
        np.testing.assert_allclose(
            added(params, params.replace(airframe=None)), expected, rtol=1e-3, atol=2e-5
        )
    force_z, moment = residual_force_moment(residual, rpm, air, physics.body.rates)
    params = build_plant(zoo.replace(effects=on, residual="standin_residual.npz"))
    expected = np.concatenate([[0.0, 0.0, force_z], moment.array()])
    assert abs(force_z) > 0.01
    without = build_plant(zoo.replace(effects=on))
    np.testing.assert_allclose(added(params, without), expected, rtol=1e-3, atol=2e-5)


def test_a_load_makes_all_forces_smaller_but_no_moment(rows):
    physics = jax.tree.map(lambda x: x[0], physics_of(rows))
    air, still = Vec3(*np.float32([3.0, -2.0, 1.0])), Rotors.same(np.float32(0.0))
    light, loaded = (
        jax.jit(plant.forces)(build_plant(OFF.replace(mass=mass)), physics, still, air)
        for mass in (None, 1.1 * 0.389)
    )
    np.testing.assert_allclose(light[0].array() / 1.1, loaded[0].array(), rtol=1e-5)
    np.testing.assert_allclose(light[1].array(), loaded[1].array(), rtol=1e-5)


def test_mass_propellers_and_battery_of_another_drone_are_those_of_its_file(tmp_path):
    config = load_plant_config("standin", [f"vehicle={DRONE}"])
    assert filled(PlantConfig()).rotors.radius == 0.07
    complete = filled(config)
    full = float(build_plant(config).battery.rpm_full)
    assert complete.mass == 0.6 and full == pytest.approx(25000 * 12 / 11)
    thrust, turns = 0.6 * 1.5696e-08, 1.0 / 60.0  # N of a rotor, turns a second, at 1 rpm
    coefficient = thrust / (1.225 * turns**2 * (2.0 * complete.rotors.radius) ** 4)
    assert coefficient == pytest.approx(0.13, abs=0.001)
    assert complete.rotors.radius == pytest.approx(0.0635, rel=0.06)  # 5 inch
    given = filled(config.replace(mass=0.7, rotors=config.rotors.replace(radius=0.0635)))
    assert given.mass == 0.7 and given.rotors.radius == 0.0635
    light = tmp_path / "light.yaml"
    light.write_text(DRONE.read_text().replace("mass:", "# mass:"))
    with pytest.raises(InputError, match="light.yaml: mass is missing"):
        filled(config.replace(vehicle=str(light)))


ROTORS = filled(PlantConfig()).rotors.model_dump() | {
    "mass": 0.389,
    "ground": effects.GROUND_DISCS,
    "lock_number": effects.LOCK_NUMBER,
    "hub_stiffness": effects.HUB_STIFFNESS,
}
ROTORS["induced"] = np.sqrt(ROTORS["mass"] * 9.81 / (2.0 * 1.225 * 4.0 * np.pi * 0.07**2))


def lift_near_the_ground(rpm, v, altitude):
    ratio = source.ground_ratio(ROTORS, altitude, np.hypot(v[:, 0], v[:, 1]))
    return -ref.MOTOR["k_w"] * (rpm**2).sum(axis=1) * (ratio - 1.0)


EFFECTS = {  # specific force along z, m/s^2, or moment, N m, of rpm, body velocity, rates, altitude
    "inflow": lambda rpm, v, rates, h: source.advance_loss(ref.MOTOR, ROTORS, -v[:, 2]),
    "ground": lambda rpm, v, rates, h: lift_near_the_ground(rpm, v, h),
    "flapping": lambda rpm, v, rates, h: source.flapping(ref.MOTOR, ROTORS, rpm, v, rates),
    "gyroscopic": lambda rpm, v, rates, h: source.gyroscopic(ref.MOTOR, rpm, rates),
}


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_that_of_its_source(effect, rows, commands):
    """In the accelerations of the drone, against those without it."""
    to_body = np.swapaxes(ref.rotation(rows[:, ref.EULER]), 1, 2)
    v = ref.rotate(to_body, rows[:, ref.V])
    expected = EFFECTS[effect](rows[:, ref.RPM], v, rows[:, ref.RATES], -rows[:, 2])
    on, off = (slope(x, rows, commands).body for x in (only(**{effect: 1.0}), OFF))
    force = ref.rotate(to_body, np.float64((on.velocity - off.velocity).array()))
    inertia = [ref.MOTOR[name] for name in ("i_xx", "i_yy", "i_zz")]
    moment = np.float64((on.rates - off.rates).array()) * inertia
    if expected.ndim == 1:
        found, other, expected = force, moment, expected[:, None] * [0.0, 0.0, 1.0]
        assert np.abs(expected).max() > 0.5  # m/s^2
    else:
        found, other = moment, force
        assert np.abs(expected).max() > 1e-3  # N m
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())
    assert np.abs(other).max() < 1e-4


def test_a_unit_off_the_center_feels_the_rotation():
    params = build_plant(only(offset=1.0))
    r = np.array(PlantConfig().imu.offset)
    rates, turning = np.random.default_rng(3).normal(0.0, 5.0, (2, COUNT, 3))
    found = jax.jit(jax.vmap(effects.lever_acceleration, (None, 0, 0)))(
        params.imu, vec3(np.float32(rates)), vec3(np.float32(turning))
    )
    agree(found.array(), np.cross(turning, r) + np.cross(rates, np.cross(rates, r)), 1e-5)


def test_a_turning_drone_measures_it_at_its_unit():
    """A steady turn about z at 4 rad/s: the unit's centripetal acceleration, inwards."""
    config = only(offset=1.0)
    params = build_plant(config)
    row = np.zeros((1, 22), np.float32)
    row[0, 2], row[0, ref.RPM], row[0, ref.RATES] = -5.0, 7497.0, (0.0, 0.0, 4.0)
    body = jax.tree.map(lambda x: x[0], state_of("motor", row))
    state = plant.begin(params, body, jnp.ones(()), CALM)
    exact = plant.truth_of(build_plant(OFF), state).specific_force
    found = (plant.truth_of(params, state).specific_force - exact).array()
    x, y, _ = config.imu.offset
    np.testing.assert_allclose(found, [-16.0 * x, -16.0 * y, 0.0], atol=1e-5)


def test_vibration_has_the_frequency_and_size_of_the_rotors():
    config = only(vibration=1.0).replace(delay=LATE)
    params = build_plant(config)
    row = np.zeros((1, 22), np.float32)
    row[0, 2], row[0, ref.RPM] = -5.0, 6000.0
    body = jax.tree.map(lambda x: x[0], state_of("motor", row))
    state = plant.begin(params, body, jnp.ones(()), CALM)
    hover = float(params.hover)
    shaking = []
    update, shake, rpm = compiled_update(), jax.jit(effects.vibration), np.float32(6000.0)
    for _ in range(50):  # 100 turns a second: a period is five samples
        state = update(params, state, Rotors.same(rpm), CALM[: gusts.DRAWS])
        force, rates = shake(params.imu, params.hover, state.physics.body.actuators, state.phase)
        shaking.append([float(x) for x in (*force.components(), *rates.components())])
    measured = np.array(shaking)
    size = 4.0 * (6000.0 / hover) ** 2 * np.array([config.imu.vibration, effects.GYRO_VIBRATION])
    spectrum = np.abs(np.fft.rfft(measured, axis=0)) / 25.0
    assert np.all(spectrum.argmax(axis=0) == 10)  # 10 periods in 50 samples
    np.testing.assert_allclose(spectrum[10], np.repeat(size, 3), rtol=1e-3)
    off = plant.truth_of(build_plant(OFF), state)
    np.testing.assert_array_equal(off.rates.array(), state.physics.body.rates.array())


def test_commands_arrive_late():
    params = build_plant(OFF.replace(delay=LATE))
    assert params.command_delay == 3
    row = np.zeros(22, np.float32)
    row[ref.RPM] = 7000.0
    state = plant.begin(params, state_of("motor", row), jnp.ones(()), CALM)
    update, rpm = compiled_update(), np.float32(9000.0)
    speeds = []
    for _ in range(5):
        state = update(params, state, Rotors.same(rpm), CALM[: gusts.DRAWS])
        speeds.append(float(state.physics.body.actuators.w1))
    assert speeds[:3] == [7000.0] * 3 and speeds[3] > 7000.0


def test_constants_are_drawn_once_within_their_spread():
    config = only(constants=1.0)
    factors, rotor_factors = drawn_factors(config)
    values = np.array(list(factors.values()))
    assert np.abs(values - 1.0).max() <= config.constants.spread and values.std() > 0.005
    assert not {"g", "rpm_min", "rpm_max"} & set(factors)
    assert drawn_factors(config)[0] == factors and np.ptp(rotor_factors) > 0
    other = config.replace(constants=config.constants.replace(seed=9))
    assert drawn_factors(other)[0] != factors
    off, level = drawn_factors(OFF)
    assert set(off.values()) == {1.0} and np.all(level == 1.0)
