"""Flights that nothing is learned from: on several drawn plants, and of the plant's own numbers."""

import json

import numpy as np
import pytest

from quadjax.plant.build import drawn_factors
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.studies.improve import check, reference
from quadjax.studies.improve.flights import Flown
from quadjax.studies.improve.reference import PlantModel, exact, plant_model
from quadjax.studies.improve.rounds import Round
from quadjax.studies.improve.run import Setting
from quadjax.vehicle.vehicle_file import read_vehicle
from tests.improve.support import FIT, drone_log, policy_file, race

SILENT = {"report": lambda line: None}
PLANT = load_plant_config("standin")


@pytest.fixture
def flown(monkeypatch):
    """Learning and flights without computation; the policies and plants that were checked."""
    seen = []

    def improve(setting, folder, report):
        Policy.load(setting.policy).save(folder / "policy.npz")
        hit = Flown([2.0, 8.0], [None, 8.0], ["hit a gate", ""])
        return [Round(hit, None, "too short", 30.0, 0.2, 1)]

    def fly(config, plant, policy, count, laps, seed):
        seed = plant.constants.seed
        seen.append((policy.name, seed))
        total = 9.0 if policy.name == "first.npz" else 8.0 - 0.1 * seed
        return Flown([total] * count, [total] * (count - 1) + [None], [""] * count)

    monkeypatch.setattr(check, "improve", improve)
    monkeypatch.setattr(check, "fly", fly)
    return seen


def test_each_plant_is_learned_from_the_first_policy_and_checked_once(tmp_path, flown):
    setting = Setting(race(), policy_file(tmp_path), FIT, PLANT, check=2)
    results = check.improve_plants(setting, tmp_path, 2, **SILENT)
    assert flown == [("first.npz", 1), ("policy.npz", 1), ("first.npz", 2), ("policy.npz", 2)]
    more = check.improve_plants(setting, tmp_path, 3, **SILENT)
    assert more[:2] == results and flown[4:] == [("first.npz", 3), ("policy.npz", 3)]
    text = check.plants_table(more)
    assert "| 2 | 9.00 (1 of 2) | 7.80 (1 of 2) | - | 10 | 30 | none |" in text
    assert "| all | 9.00 (3 of 6) | 7.80 (3 of 6) | - | 10 | 30 |  |" in text
    assert "crashes in the rounds: 3" in text
    assert (tmp_path / "plants.png").stat().st_size > 10_000
    stored = json.loads((tmp_path / "plants.json").read_text())
    assert [part["check"]["after"]["totals"][0] for part in stored] == [7.9, 7.8, 7.7]


def test_the_means_over_plants_are_of_the_plants_on_which_every_policy_finishes():
    def flown(total):
        return Flown([9.0], [total], ["" if total else "hit a gate"])

    results = [
        check.Result(1, [], {"before": flown(9.0), "after": flown(8.0)}),
        check.Result(2, [], {"before": flown(None), "after": flown(6.0)}),
    ]
    text = check.plants_table(results)
    assert "| all | 9.00 (1 of 2) | 8.00 (2 of 2) | - |" in text
    assert "means over the 1 of 2 plants on which every policy finishes" in text


def test_the_reference_has_the_steps_of_all_rounds(tmp_path, flown, monkeypatch):
    tuned = []

    def plant_model(config, plant, policy, fit, folder, seed, report):
        folder.mkdir(exist_ok=True)
        return PlantModel({}, None)

    def tune(setting, progress, logs, folder, report):
        tuned.append((setting.steps, progress.margin, folder.name))
        return setting.policy

    monkeypatch.setattr(check, "plant_model", plant_model)
    monkeypatch.setattr(check, "tune", tune)
    options = {"check": 2, "steps": 100, "reference": True}
    setting = Setting(race(), policy_file(tmp_path), FIT, PLANT, **options)
    done = Round(Flown([2.0], [8.0], [""]), None, "too short", 30.0, 0.2, 1)
    for count in (1, 3):
        found = check.checked(setting, [done] * count, tmp_path, **SILENT)
    assert tuned == [(100, 0.2, "rounds_1"), (300, 0.2, "rounds_3")]
    assert list(found) == ["before", "after", "reference"]
    assert len(flown) == 5  # that before the first round is flown once


def test_a_reference_has_the_constants_and_the_battery_of_the_plant(tmp_path, monkeypatch):
    def fly(config, plant, policy, name, folder, count, laps, seed, report):
        assert plant == exact(PLANT)
        for index in range(count):
            drone_log(folder / f"{name}_{index}.csv", index)
        return Flown([8.0] * count, [8.0] * count, [""] * count)

    monkeypatch.setattr(reference, "fly_and_log", fly)
    config, fit = race(), FIT.replace(figures=False)
    options = (policy_file(tmp_path), fit, tmp_path / "own", 0)
    model = plant_model(config, PLANT, *options, **SILENT)
    base, (factors, _) = read_vehicle(PLANT.vehicle).motor, drawn_factors(PLANT)
    for name in ("k_w", "k_p", "tau"):
        assert model.constants[name] == pytest.approx(float(getattr(base, name)) * factors[name])
    assert len(model.logs) == reference.FLIGHTS
    changed = model.race(config)
    assert changed.battery == PLANT.battery and changed.observation.highest_rpm == "none"
    assert changed.vehicle.residual == str(tmp_path / "own" / "residual.npz")
    still = PLANT.replace(effects=PLANT.effects.replace(battery=0.0))
    assert plant_model(config, still, *options, **SILENT).race(config).battery is None


def test_exact_flights_have_no_noise_and_no_effect_that_is_none_of_the_drone():
    own = exact(PLANT)
    assert own.navigation == "ground_truth" and own.constants == PLANT.constants
    noise = [own.sensors.gyro.noise, own.sensors.accelerometer.bias, own.sensors.rpm.resolution]
    np.testing.assert_array_equal([*noise, own.effects.gusts, own.delay.measurement], 0.0)
    assert own.effects.inflow == own.effects.battery == own.effects.constants == 1.0
