"""Races on the stand-in plant: both policies, what they see, and the logs they leave."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_logs
from quadjax.fitting.synthetic_log import write_log
from quadjax.plant.flight_log import gate_centres, log_columns, write_logs
from quadjax.plant.plant_schema import PlantConfig
from quadjax.plant.race import fly_plan, plan_flights, race_config, recordings
from quadjax.policy.file import read_policy

ROOT = Path(__file__).resolve().parents[2]
PRETRAINED = ROOT / "quadjax" / "pretrained"


def flown(name: str, **changes: object):
    config = load_config(ROOT / "configs" / "e2e.yaml")
    policy = read_policy(PRETRAINED / name)
    plant = dataclasses.replace(PlantConfig(), **changes)
    return config, fly_plan(plan_flights(config, plant, policy, name, 1, 2, 2), seed=3)


@pytest.fixture(scope="module")
def e2e():
    return flown("e2e.npz")


@pytest.fixture(scope="module")
def indi():
    return flown("indi.npz", navigation="truth", control_rate=100.0)


@pytest.mark.parametrize("name", ["e2e", "indi"])
def test_a_policy_flies_a_lap(name, request):
    _, flights = request.getfixturevalue(name)
    assert flights.laps.lap_times.shape == (2, 1)
    for run, flight in enumerate(recordings(flights)):
        assert flight.time[-1] > 1.0 and flight.motor_level
        if not flight.crash:
            assert 2.0 < flights.laps.totals[run] < 5.0
            end = np.linalg.norm(flight.position[-1] - [-2.0, -1.5, -1.5])
            assert end < 1.0  # the last gate


def test_policies_see_estimates(e2e, indi):
    """Near the truth and not it, but for the development's switch."""
    for (_, flights), exact in ((e2e, False), (indi, True)):
        going = ~flights.frames.over[:, 0]
        true = np.asarray(flights.frames.true.position.x)[going, 0]
        believed = np.asarray(flights.frames.believed.position.x)[going, 0]
        error = np.abs(believed - true)
        if exact:  # one sample late
            assert error.max() < 0.05
        else:
            assert 1e-5 < error.mean() < 0.05


def test_the_fit_takes_its_logs(e2e, tmp_path):
    config, flights = e2e
    columns = log_columns(flights, 0, gate_centres(config))
    assert {"time", "pos_x", "att_psi", "rpm_ref_4", "ekf_X12", "target_gate_z"} <= set(columns)
    path = tmp_path / "flight.csv"
    write_log(path, columns)
    log = read_logs(LogsConfig(files=[str(path)], format="paparazzi", min_seconds=1.0), Path())[0]
    assert log.sample_rate == pytest.approx(500.0, rel=1e-3) and log.flying.all()
    assert np.abs(log.specific_force[:, 2].mean()) > 5.0


def test_logs_of_policies_are_written_by_name(tmp_path):
    race, plant = load_config(ROOT / "configs" / "e2e.yaml"), PlantConfig(navigation="truth")
    policies = [PRETRAINED / "indi.npz"]
    written = write_logs(race, plant, policies, tmp_path / "logs", flights=2, laps=1, seed=3)
    assert [log.path.name for log in written] == ["indi_0.csv", "indi_1.csv"]
    for log in written:
        assert len(log.path.read_text().splitlines()) == log.rows + 1
        assert log.crash or log.rows > 500 * 2.0


def test_the_race_is_the_policys_own(e2e):
    config, _ = e2e
    policy = read_policy(PRETRAINED / "indi.npz")
    race = race_config(config, policy)
    assert race.vehicle.kind == "rate" and race.episode.disturbance_input == "true"
    widths = dataclasses.replace(policy, observation={"disturbance": {"moment_x": 0.03}})
    assert race_config(config, widths).disturbance.moment_x == 0.03
