"""The rate-and-thrust model from flights with an inner loop: known constants come back."""

from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.fitting.config import LogsConfig, load_fit_config
from quadjax.fitting.flight_log import read_log, write_flight, write_log
from quadjax.fitting.formats import paparazzi_columns
from quadjax.fitting.motors import fit_rate_model
from quadjax.fitting.samples import airborne
from quadjax.fitting.signals import first_order
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.vehicle_file import read_vehicle

from .flights import RATE, simulated

TRUE = {"tau_rate": 0.045, "tau_thrust": 0.035, "d_x": 0.3, "d_y": 0.4}
BASE = {"tau_rate": 0.03, "tau_thrust": 0.03, "d_x": 1.0, "d_y": 1.0}


def steps(random, count, width, size):
    """Random levels that change every 0.2 s (n, width)."""
    return size * np.repeat(random.uniform(-1.0, 1.0, (count // 50 + 1, width)), 50, 0)[:count]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Flights whose rates and thrust follow their commands exactly, with sensor noise."""
    return [following(seed, tmp_path_factory.mktemp("rate") / "flight.csv") for seed in (1, 2, 3)]


def following(seed, path):
    random, columns = np.random.default_rng(seed), simulated(seed)
    count = len(columns["time"])
    rates, thrust = steps(random, count, 3, 2.0), 10.0 + steps(random, count, 1, 4.0)
    commands = {"rate_command": rates, "thrust_command": thrust}
    write_log(path, columns | paparazzi_columns(commands))
    flight = read_log(path, LogsConfig(format="paparazzi"))
    np.testing.assert_allclose(flight["rate_command"], rates, rtol=1e-6)
    np.testing.assert_allclose(flight["thrust_command"], thrust, rtol=1e-6)
    v = flight["body_velocity"]
    lift = first_order(thrust, thrust[0], TRUE["tau_thrust"], 1.0 / RATE)
    force = np.stack([-TRUE["d_x"] * v[:, 0], -TRUE["d_y"] * v[:, 1], -lift[:, 0]], axis=1)
    followed = first_order(rates, rates[0], TRUE["tau_rate"], 1.0 / RATE)
    return flight.with_signals(
        rates=followed + random.normal(0.0, 0.01, (count, 3)),
        specific_force=force + random.normal(0.0, 0.3, (count, 3)),
    )


@pytest.fixture(scope="module")
def log(logs):
    return logs[0]


def fitted(logs):
    """Constants and their standard errors by name, R^2 of the first of each part, and warnings."""
    base = read_vehicle("bebop1.yaml").constants("rate").replace(**BASE)
    parts = fit_rate_model(logs, [airborne(log) for log in logs], base)
    return SimpleNamespace(
        values={name: value for part in parts for name, value in part.constants.items()},
        errors={name: value for part in parts for name, value in part.errors.items()},
        r_squared={next(iter(part.constants)): part.r_squared for part in parts},
        warnings=[line for part in parts for line in part.warnings],
    )


def test_known_constants_come_back(logs):
    fit = fitted(logs)
    for name, true in TRUE.items():
        assert abs(fit.values[name] / true - 1.0) < 0.03, name
        assert abs(fit.values[name] - true) < 4.0 * fit.errors[name], name
    assert not fit.warnings and fit.r_squared["tau_rate"] > 0.99


def test_commands_that_never_change_keep_the_base_value(log):
    still = log.with_signals(rate_command=0.0 * log["rate_command"])
    fit = fitted([still])
    assert fit.values["tau_rate"] == 0.03 and "never change" in fit.warnings[0]


def test_the_order_of_the_flights_has_no_influence(log):
    """Blocks of half a second, from which standard errors are computed, end with a flight."""
    parts = [log.slice(slice(0, 833)), log.slice(slice(833, None))]
    first, second = fitted(parts), fitted(parts[::-1])
    for name in TRUE:
        assert first.values[name] == pytest.approx(second.values[name], rel=1e-4)
        errors = first.errors[name], second.errors[name]
        assert errors[0] == pytest.approx(errors[1], rel=1e-4)


def test_a_simulated_flight_is_a_plain_log(log, tmp_path):
    """As ``quadjax sil --autopilot betaflight`` writes it, with speeds in rad/s."""
    speeds = log["actuators"] / RPM_PER_RAD_S
    command = np.random.default_rng(0).uniform(0.0, 1.0, speeds.shape)
    flight = log.with_signals(actuators=speeds, command=command)
    write_flight(tmp_path / "log_0.csv", flight)
    unchecked = {"max_scale_error": 1e6, "max_angle": 180.0, "max_delay": 1e6}
    config = load_fit_config("betaflight").logs.replace(**unchecked)
    read = read_log(tmp_path / "log_0.csv", config)
    for name in ("rate_command", "thrust_command", "rates", "specific_force", "position"):
        np.testing.assert_allclose(read[name], log[name], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(read["actuators"], log["actuators"], rtol=1e-5)
    np.testing.assert_allclose(read["motor_command"], command, atol=1e-6)
    np.testing.assert_allclose(read["body_velocity"], log["body_velocity"], atol=1e-4)
    other = read_log(tmp_path / "log_0.csv", config.replace(columns={}))
    assert "motor_command" not in other.signals  # those of other plain logs may be pulse widths
