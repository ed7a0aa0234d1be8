"""The filter on whole flights: all of them share two compiled programs of 64 drones."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS
from quadjax.plant import flights, watch
from quadjax.plant.covariance import Covariance
from quadjax.plant.flights import Setting
from quadjax.plant.sensor_schema import (
    NO_ERRORS,
    EkfConfig,
    MocapConfig,
    NavigationConfig,
    SensorsConfig,
)
from quadjax.policy.file import read_policy
from quadjax.studies import consistency
from tests.plant.support import EXACT, ONLY_LATE, RATE, at, correlation, loop, navigation

DRONES, SECONDS, CHUNK = 64, 3.0, 250
SETTING = Setting(RATE, DRONES, SECONDS)
FAST = EkfConfig(start_velocity=6.0)  # m/s: a loop does not start at rest


@pytest.fixture(scope="module")
def plans():
    return {
        name: flights.plan_flights(
            load_config(CONFIGS / f"{name}.yaml"),
            read_policy(consistency.PRETRAINED / f"{name}.npz"),
            SETTING,
            name,
        )
        for name in consistency.SHIPPED
    }


def _filtered(config, seen, seed=0):
    """Sensors and filter of 64 drones on a known flight whose first sample is the start."""
    onboard = watch.onboard_of(config, RATE)
    key = jax.random.key(seed)
    watched = watch.start_all(onboard, at(seen.truth, 0), key)
    for first in range(1, seen.over.shape[0], CHUNK):
        part = at(seen, slice(first, first + CHUNK))
        watched = watch.watch_all(onboard, watched, part, jax.random.fold_in(key, first))
    return onboard, watched


def _largest(vector):
    return float(jnp.abs(vector.array()).max())


@pytest.mark.parametrize("name", consistency.SHIPPED)
def test_errors_stay_within_three_standard_deviations(plans, name):
    seen = []
    result = watch.judge(plans[name], SETTING, NavigationConfig(), seen.append)
    print(name, result)
    assert sum(seen) == plans[name].control_steps == 300
    assert result.flights == DRONES and result.whole > 0.7 * DRONES
    assert result.hours > 0.8 * DRONES * SECONDS / 3600.0
    assert result.diverged == 0
    assert (result.inside > 0.99).all()
    # Nor are the standard deviations merely large: errors are a good part of them.
    assert (result.ratio > 0.15).all() and (result.ratio < 1.5).all()
    position, velocity, euler = result.rmse[:3]
    assert position.max() < 0.001 and velocity.max() < 0.02 and euler.max() < 0.005


def test_tally_sees_a_filter_that_is_too_sure(plans):
    sure = EkfConfig(start_velocity=1e-3, accelerometer_noise=0.0)
    sensors = SensorsConfig(mocap=MocapConfig(position_noise=0.0))
    config = NavigationConfig(sensors, sure)
    short = Setting(RATE, DRONES, 0.5, from_hover=False)
    plan = plans["e2e"]
    plan = type(plan)(plan.choices, plan.params, plan.pilot, plan.hold, 50)
    result = watch.judge(plan, short, config)
    assert result.inside[1].max() < 0.9  # it starts at up to half a metre a second, not at rest
    assert not consistency.hit(result)


def test_late_poses_are_taken_in_where_they_belong():
    seen = loop(1 + 3 * CHUNK, DRONES)
    onboard, watched = _filtered(navigation(ONLY_LATE), seen)
    errors, std = watched.tally.error, watched.tally.std
    speed = 6.0  # m/s: the pose that arrives is 12 cm old
    assert onboard.ekf.lag == 9 and onboard.sensors.delay == 10
    assert _largest(errors.position) < 0.01 * speed * 0.02
    assert _largest(errors.velocity) < 0.02
    assert _largest(errors.euler) < 2e-3
    assert _largest(errors.rates) < 1e-3 and _largest(errors.specific_force) < 0.2
    assert all(bool((x > 0).all()) for x in jax.tree.leaves(std))


def test_pitch_of_90_deg_is_no_singularity():
    seen = loop(1 + 3 * CHUNK, DRONES)
    assert float(jnp.abs(seen.truth.euler.y).max()) > 1.56
    _, watched = _filtered(NavigationConfig(ekf=FAST), seen, seed=2)
    tally = watched.tally
    assert _largest(tally.error.velocity) < 0.2 and _largest(tally.error.euler) < 0.02
    inside = [
        np.float64(x).sum() / (DRONES * 3 * CHUNK) for x in tally.inside.velocity.components()
    ]
    assert min(inside) > 0.99


def test_covariance_stays_symmetric_and_positive_through_long_gaps():
    gaps = SensorsConfig(mocap=MocapConfig(dropout=0.6, dropout_frames=60.0))
    seen = loop(1 + 4 * CHUNK, DRONES)
    _, watched = _filtered(NavigationConfig(gaps, FAST), seen, seed=4)
    dense = np.float64(jax.vmap(Covariance.array, -1)(watched.ekf.covariance))
    for p in dense:
        np.testing.assert_array_equal(p, p.T)
        assert np.linalg.eigvalsh(correlation(p, p)).min() > 0
    spread = dense[:, 0, 0]
    assert spread.max() > 9 * spread.min()  # some are in a gap now, and know it
    pairs = zip(*map(jax.tree.leaves, (watched.tally.error, watched.tally.std)), strict=True)
    ratios = [np.abs(error) / std for error, std in pairs]
    assert np.mean(np.array(ratios) < 3.0) > 0.98


def test_with_every_error_off_the_estimate_is_the_truth(plans):
    under_way, truth = flights.begin(plans["e2e"], SETTING)
    onboard = watch.onboard_of(NavigationConfig(NO_ERRORS, EXACT), RATE)
    watched = watch.start_all(onboard, truth, jax.random.key(0))
    for index in range(4):
        key = jax.random.key(index)
        under_way, seen = flights.fly_on(plans["e2e"], under_way, key, 50)
        watched = watch.watch_all(onboard, watched, seen, key)
    assert not np.asarray(under_way.over).any()
    errors = watched.tally.error
    limits = {
        "position": 1e-4,
        "velocity": 1e-2,
        "euler": 1e-3,
        "rates": 2e-3,
        "specific_force": 3e-2,
    }
    for name, limit in limits.items():
        print(name, _largest(getattr(errors, name)))
        assert _largest(getattr(errors, name)) < limit


def _command(monkeypatch, words):
    monkeypatch.setattr("sys.argv", ["consistency", *words])
    with pytest.raises(SystemExit) as end:
        consistency.main()
    return end.value.code


def test_command_prints_writes_and_says_whether_it_hit(tmp_path, capsys, monkeypatch):
    path = tmp_path / "numbers.json"
    words = ["--flights", "64", "--seconds", "0.5", "--json", str(path)]
    words += ["--config", str(CONFIGS / "e2e.yaml"), "sensors.mocap.dropout=0.1"]
    status = _command(monkeypatch, words)
    written = json.loads(path.read_text())
    assert written["config"]["sensors"]["mocap"]["dropout"] == 0.1
    result = written["results"]["e2e"]
    assert result["flights"] == 64 and result["diverged"] == 0
    # So few flights and so short: one of 64 may be outside, and the command says so.
    assert np.min(result["inside"]) > 0.97
    assert result["hit"] is bool(np.min(result["inside"]) >= 0.99)
    assert status == int(not result["hit"])
    verdict = "hit" if result["hit"] else "missed"
    assert f"{verdict}: 99% inside, none diverged" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["sensors.mocap.latency=2"], "sensors.mocap.latency is 2"),
        (["sensors.sonar=1"], "unknown key sensors.sonar"),
        (["--rate", "100"], "sensors.gyro.low_pass is 98.0"),
        (["--rate", "0"], "expected a number above 0"),
        (["--policy", "x.npz"], "--policy needs the --config"),
    ],
)
def test_command_complains_in_one_line(words, complaint, capsys, monkeypatch):
    assert _command(monkeypatch, ["--flights", "2", "--seconds", "0.1", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert complaint in error and "\n" not in error


def test_errors_of_the_filter_are_input_errors():
    with pytest.raises(InputError, match="ekf.attitude_noise is 0.0"):
        watch.onboard_of(NavigationConfig(ekf=EkfConfig(attitude_noise=0.0)), RATE)
