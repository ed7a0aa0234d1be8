"""Lags from logs that have a row for every k-th step of the control loop."""

import numpy as np
import pytest

from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import log_flight, read_log
from quadjax.fitting.lags import BETWEEN
from quadjax.fitting.motors import fit_battery, fit_motors, with_simulated_speeds
from quadjax.fitting.samples import airborne
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.vehicle_file import read_vehicle

from . import racing_logs
from .conftest import REPOSITORY


@pytest.fixture(scope="module")
def flown():
    truth = racing_logs.constants(REPOSITORY / "configs/vehicles/5inch.yaml")
    return racing_logs.fly(truth, seed=1, seconds=6.0)


def _every(flown, k, form, folder):
    """The log of every k-th row of a flight of 500 Hz."""
    part, path = {name: values[::k] for name, values in flown.items()}, folder / "flight.csv"
    if form == "tii":
        racing_logs.write_tii(path, racing_logs.tii_columns(part))
    else:
        racing_logs.write_blackbox(path, racing_logs.blackbox_columns(part))
    return read_log(path, LogsConfig(format=form))


@pytest.mark.parametrize(
    ("form", "k"), [*(("blackbox", k) for k in (1, 2, 4, 5, 10)), ("tii", 4), ("tii", 10)]
)
def test_the_motors_lag_does_not_depend_on_the_rate_of_the_log(form, k, flown, tmp_path):
    """Within 2 standard errors of 0.04 s, or 0.5%, with a base vehicle that is 30% off."""
    log = _every(flown, k, form, tmp_path)
    base = read_vehicle("5inch.yaml").racing.replace(tau=0.052, k=0.5)
    fit = fit_motors([log], [airborne(log)], base)
    assert abs(fit.constants["tau"] - 0.04) < max(2.0 * fit.errors["tau"], 0.0002)
    assert fit.constants["k"] == pytest.approx(0.95, rel=0.01)
    # Each command is held for 1/k of a row.
    assert fit.constants.get(BETWEEN, 0.0) == pytest.approx(1.0 - 1.0 / k, abs=0.08)
    if form == "tii":
        values = np.array(list(fit.constants.values()))
        speeds = with_simulated_speeds(log, values[:4], values[4])["actuators"] * np.pi / 30.0
        rows = log.time - log.time[0] > 0.5
        error = (speeds - flown["speed"][::k][: len(speeds)])[rows]
        assert np.sqrt((error**2).mean()) < 0.01 * flown["speed"].mean()


@pytest.mark.parametrize("k", [1, 5])
def test_the_lag_of_commanded_speeds_does_not_either(k):
    """Sums of sines that the loop holds for 2 ms; the solution of each step is exact."""
    random, tau, step, count = np.random.default_rng(0), 0.05, 0.002, 3000
    time = step * np.arange(count)[:, None]
    waves = [
        300.0 * np.sin(2.0 * np.pi * (f * time + random.uniform(size=4)))
        for f in random.uniform(0.5, 8.0, (6, 4))
    ]
    command, rpm = 7500.0 + sum(waves), np.empty((count, 4))
    rpm[0], kept = 7500.0, np.exp(-step / tau)
    for i in range(count - 1):
        rpm[i + 1] = command[i] + kept * (rpm[i] - command[i])
    quantities = {"time": time[:, 0], "rpm_command": command}
    quantities["rpm"] = rpm + 20.0 * random.normal(size=rpm.shape)
    quantities |= dict.fromkeys(("gyro", "acceleration", "body_velocity"), np.zeros((count, 3)))
    log = log_flight("flight", {name: values[::k] for name, values in quantities.items()})
    rows, battery = [np.ones(len(log.time), bool)], BatteryConfig().filled(11000.0)
    estimate, limit = fit_battery([log], 7500.0, battery, rows, 0.1)
    assert abs(limit.tau - tau) < 2.0 * estimate.errors["tau"]
    assert (BETWEEN in estimate.constants) == (k > 1)


def test_a_slow_log_that_cannot_show_it_says_how_wrong_the_lag_may_be(flown, tmp_path):
    """So much noise on the speeds that the commands between rows of 20 ms make no difference."""
    log = _every(flown, 10, "blackbox", tmp_path)
    noise = 6000.0 * np.random.default_rng(0).normal(size=log["actuators"].shape)
    log = log.with_signals(actuators=log["actuators"] + noise)
    fit = fit_motors([log], [airborne(log)], read_vehicle("5inch.yaml").racing)
    assert BETWEEN not in fit.constants
    (line,) = (line for line in fit.warnings if "too short" in line)
    assert line.startswith("tau (motors) may be up to 0.01 s too short: the logs have a row every")
