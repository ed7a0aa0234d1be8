"""The rounds of fly, refit and fine-tune: each step once, also after a stop; and the command."""

import dataclasses
import json

import pytest

from quadjax import improve as rounds
from quadjax.core.errors import InputError
from quadjax.improve import Setting, fly_rounds, learn, rounds_table
from quadjax.plant.config import PlantConfig
from quadjax.policy.file import Policy
from tests.commands import run
from tests.improve.support import FIT, STEPS, TINY, drone_log, policy_file, race
from tests.race.support import BLANK

SILENT = {"report": lambda line: None}


def setting_of(folder, **changes):
    values = {"race": race(), "policy": policy_file(folder), "fit": FIT, "plant": PlantConfig()}
    return Setting(**(values | {"steps": STEPS, "rounds": 1, "check": 0} | changes))


@pytest.fixture
def flights(monkeypatch):
    """Flights of a simulated drone in place of the plant; the policies that flew, in order."""
    flown = []

    def fly(setting, state, name, folder, seed, report):
        flown.append(state.policy)
        count = setting.flights
        for index in range(count):
            drone_log(folder / f"{name}_{index}.csv", 10 * seed + index)
        return {"seconds": [8.0] * count, "totals": [8.0] * count, "crashes": [""] * count}

    monkeypatch.setattr(rounds, "fly_and_log", fly)
    return flown


@pytest.mark.slow
def test_a_stopped_command_repeats_no_step(tmp_path, flights, monkeypatch):
    setting, folder = setting_of(tmp_path), tmp_path / "out"
    folder.mkdir()
    setting.start(folder)
    trained = rounds.train

    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(rounds, "train", stop)
    with pytest.raises(KeyboardInterrupt):
        fly_rounds(setting, folder, **SILENT)
    monkeypatch.setattr(rounds, "train", trained)
    model = (folder / "round_1" / "model.json").stat().st_mtime_ns
    (done,) = fly_rounds(setting, folder, **SILENT)
    assert (folder / "round_1" / "model.json").stat().st_mtime_ns == model
    assert len(flights) == 1 and done.refitted.rejection == "" and done.refitted.change < -0.1
    first, policy = Policy.load(setting.policy), Policy.load(folder / "policy.npz")
    assert (first.layers[0][0] != policy.layers[0][0]).any()
    one, two = fly_rounds(setting_of(tmp_path, rounds=2), folder, **SILENT)
    assert flights == [setting.policy, folder / "round_1" / "training" / "policy.npz"]
    assert one == done
    text = rounds_table([one, two], {})
    assert text.count("\n| 1 | 2 of 2 | 8.00 | 16 | accepted |") == 1
    assert text.count("\n| 2 | 2 of 2 | 8.00 | 32 | rejected |") == 1
    assert "round 2: the model is rejected: its error on held-out flights" in text
    assert not (folder / "round_2" / "training").exists()
    with pytest.raises(InputError, match="improve.json has another seed"):
        setting_of(tmp_path, seed=1).start(folder)


@pytest.mark.slow
def test_flights_on_the_plant_that_crash_are_counted_once(tmp_path, capsys):
    """A policy that falls crashes before its logs can be fitted: nothing changes."""
    policy = policy_file(tmp_path)
    falls = Policy.load(policy)
    falls.layers[-1][1][:] = -10.0
    falls.save(policy)
    options = ("--rounds", 1, "--check", 0, "--laps", 1, "--plant-seed", 3)
    command = ("improve", BLANK, *TINY, "--policy", policy, *options, "--output", tmp_path / "out")
    assert run(*command) == 0
    text = capsys.readouterr().out
    assert "| 1 | 0 of 2 | - |" in text and "| none |" in text
    assert "crashes in the rounds: 2" in text and "shorter than logs.min_seconds" in text
    flown = json.loads((tmp_path / "out" / "round_1" / "flights.json").read_text())
    assert len(flown["crashes"]) == 2 and all(flown["crashes"])
    first, last = Policy.load(policy), Policy.load(tmp_path / "out" / "policy.npz")
    assert (first.layers[0][0] == last.layers[0][0]).all()
    assert run(*command) == 0 and capsys.readouterr().out == text


def test_the_first_and_the_last_policy_are_checked_once(tmp_path, monkeypatch):
    checked = []

    def fly(setting, policy):
        checked.append(policy.name)
        return {"seconds": [9.0] * 2, "totals": [9.0, None], "crashes": ["", "hit a gate"]}

    monkeypatch.setattr(rounds, "fly_checks", fly)
    setting = setting_of(tmp_path, check=2)
    found = rounds.checked(setting, 1, tmp_path, **SILENT)
    assert list(found) == ["before", "after"]
    assert rounds.checked(setting, 1, tmp_path, **SILENT) == found
    rounds.checked(setting, 2, tmp_path, **SILENT)  # after one more round
    assert checked == ["first.npz", "policy.npz", "policy.npz"]
    for name in ("before", "after"):
        assert f"| check, {name} | 1 of 2 | 9.00 |" in rounds_table([], found)


@pytest.mark.slow
def test_real_logs_are_fitted_without_flying(tmp_path, flights, capsys):
    logs = [drone_log(tmp_path / f"flight_{seed}.csv", seed) for seed in range(2)]
    setting = setting_of(tmp_path, plant=None, logs=tuple(logs))
    (tmp_path / "out").mkdir()
    found = learn(setting, tmp_path / "out", **SILENT)
    assert found.rejection == "" and flights == []
    assert (tmp_path / "out" / "policy.npz").exists()


def test_a_policy_of_another_vehicle_or_without_a_critic_is_refused(tmp_path):
    setting = setting_of(tmp_path)
    own = Policy.load(setting.policy)
    dataclasses.replace(own, value=None).save(setting.policy)
    with pytest.raises(InputError, match="has no critic"):
        setting.check_policy()
    drawn = race("randomization.all=0.2", "observation.critic_constants=true")
    with pytest.raises(InputError, match="critic_constants is true, allowed: false"):
        dataclasses.replace(setting, race=drawn).check_policy()
    for word, says in (
        ("network.hidden=[9]", r"has hidden widths \[8\], the config has \[9\]"),
        ("observation.gates_ahead=2", r"has observation \["),
    ):
        with pytest.raises(InputError, match=says):
            dataclasses.replace(setting_of(tmp_path), race=race(word)).check_policy()
    policy_file(tmp_path, race("vehicle.model=rate"))
    with pytest.raises(InputError, match="has vehicle rate, the config has motor"):
        setting.check_policy()
