"""The battery's limit of the propeller speeds, from commands and measured speeds."""

import numpy as np
import pytest

from quadjax.fitting import regression
from quadjax.fitting.flight_log import log_flight
from quadjax.fitting.motors import compute_drain
from quadjax.fitting.motors import fit_battery as fit_lag_and_battery
from quadjax.flights import Flight
from quadjax.vehicle.battery import BatteryConfig

HOVER, HIGHEST, TAU, RATE = 7500.0, 11000.0, 0.05, 200.0
BATTERY = BatteryConfig().filled(11000.0)


def fit_battery(logs, hover, base):
    rows = [np.ones(len(log.time), bool) for log in logs]
    return fit_lag_and_battery(logs, hover, base, rows, TAU)[1]


def flight(
    charge: float, seed: int, battery: BatteryConfig | None = BATTERY, seconds: int = 8
) -> Flight:
    """Motors that follow steps of the command under a battery, with noise, by Euler's method."""
    random = np.random.default_rng(seed)
    count, step = seconds * int(RATE), 1.0 / RATE
    command = np.repeat(random.choice([4000.0, 8000.0, HIGHEST], (count // 40, 4)), 40, axis=0)
    rpm = np.empty((count, 4))
    speed = np.full(4, HOVER)
    drop = BATTERY.drop / BATTERY.voltage
    sag = BATTERY.resistance * BATTERY.hover_current / BATTERY.voltage
    for index in range(count):
        rpm[index] = speed
        load = np.mean((speed / HOVER) ** 3)
        top = np.inf
        if battery is not None:
            top = battery.rpm_full * (1.0 - drop * (1.0 - charge) - sag * load)
        charge -= step * load * BATTERY.hover_current / (3600.0 * BATTERY.capacity)
        kept = np.exp(-step / TAU)
        speed = kept * speed + (1.0 - kept) * np.minimum(command[index], top)
    nothing = np.zeros((count, 3))
    quantities = {"time": step * np.arange(count), "rpm_command": command}
    quantities |= dict.fromkeys(("gyro", "acceleration", "body_velocity"), nothing)
    return log_flight(
        f"flight_{seed}", quantities | {"rpm": rpm + 20.0 * random.normal(size=(count, 4))}
    )


def test_lag_and_limit_are_found():
    found = fit_battery([flight(0.9, 1), flight(0.7, 2)], HOVER, BATTERY)
    sag = BATTERY.rpm_full * BATTERY.resistance * BATTERY.hover_current / BATTERY.voltage
    assert found.tau == pytest.approx(TAU, rel=0.02) and found.converged
    assert found.sag == pytest.approx(sag, rel=0.05)
    lower = 0.2 * BATTERY.rpm_full * BATTERY.drop / BATTERY.voltage
    first = found.first["flight_1"] - found.first["flight_2"]
    assert first == pytest.approx(lower, rel=0.1)
    assert found.rmse == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize("name", ["tau", "drain"])
def test_a_flight_may_have_the_name_of_a_constant(name):
    """Its highest speed at the start is not that constant."""
    logs = [flight(0.9, 1), flight(0.7, 2)]
    expected, found = (
        fit_battery([first, logs[1]], HOVER, BATTERY)
        for first in (logs[0], logs[0].replace(name=name))
    )
    assert (found.tau, found.sag, found.drain) == (expected.tau, expected.sag, expected.drain)
    assert found.first == {name: expected.first["flight_1"], "flight_2": expected.first["flight_2"]}


def test_a_solver_that_stops_before_it_converges_is_reported(monkeypatch):
    monkeypatch.setattr(regression, "MAX_STEPS", 2)
    found = fit_battery([flight(0.9, 1), flight(0.7, 2)], HOVER, BATTERY)
    assert not found.converged


def test_the_drain_is_fitted_to_long_flights_only():
    used = compute_drain(BATTERY)
    other = BATTERY.replace(capacity=0.5 * BATTERY.capacity)
    assert used == pytest.approx(2.15, abs=0.01) and compute_drain(other) == pytest.approx(
        2.0 * used
    )
    long = fit_battery([flight(0.9, 1, seconds=24)], HOVER, other)
    short = fit_battery([flight(0.9, 1, seconds=4)], HOVER, other)
    assert long.drain == pytest.approx(used, rel=0.1)
    assert short.drain == compute_drain(other) and short.tau == pytest.approx(TAU, rel=0.05)


def test_without_a_limit_there_is_no_battery():
    found = fit_battery([flight(1.0, 1, None), flight(1.0, 2, None)], HOVER, BATTERY)
    assert found.first == {}
    assert found.tau == pytest.approx(TAU, rel=0.02)
