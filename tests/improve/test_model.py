"""A refitted model: what it is made of, and when it is accepted."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.fitting.config import BodyConfig, FitConfig
from quadjax.fitting.fit import check_speeds
from quadjax.fitting.flight_log import log_flight, read_log
from quadjax.fitting.motors import BatteryFit
from quadjax.fitting.nominal import AXES
from quadjax.flights import save
from quadjax.improve import Round, tuning_config
from quadjax.refit import (
    SPEEDS,
    STATES,
    Model,
    clearances,
    margin_of,
    refit,
    rejection,
    spread_of,
    states_of_logs,
)
from quadjax.training.build import training_params
from tests.improve.support import FIT, around_the_track, drone_log, policy_file, race

NAMES = (*AXES, SPEEDS)
ONES = dict.fromkeys(NAMES, 1.0)


def rejected(before, after):
    return rejection(Model({}, before=before, after=after))


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return [drone_log(folder / f"flight_{seed}.csv", seed) for seed in range(3)]


@pytest.mark.slow
def test_a_model_that_holds_is_accepted_and_once_more_it_is_refused(logs, tmp_path):
    battery = BatteryFit(0.06, 1000.0, 1.0, {"a": 9500.0}, {"a": 9400.0})
    present = dataclasses.replace(Model.of(race()), battery=battery)
    found = refit(logs, logs[1:], FIT, present, tmp_path)
    files = [read_log(path, FIT.logs) for path in logs[1:]]
    limit = present.constants["rpm_max"]
    errors = [battery.error(log, present.hover, limit) for log in files]
    assert found.before[SPEEDS] == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-6)
    assert found.rejection == "" and found.change < -0.2
    assert found.constants["k_w"] == pytest.approx(0.9 * present.constants["k_w"], rel=0.03)
    assert found.constants["rpm_max"] == present.constants["rpm_max"]
    assert Model.from_json(json.loads(json.dumps(dataclasses.asdict(found)))) == found
    again = refit(logs, logs, FIT, found, tmp_path)
    assert again.rejection.startswith("its error on held-out flights is")


def test_logs_without_commanded_speeds_have_no_error_of_the_speeds(logs, tmp_path):
    bare = []
    for log in logs[:2]:
        header, *rows = log.read_text().splitlines()
        kept = [i for i, name in enumerate(header.split(",")) if "rpm_ref" not in name]
        assert 0 < len(kept) < len(header.split(","))
        lines = [",".join(row.split(",")[i] for i in kept) for row in (header, *rows)]
        bare.append(tmp_path / log.name)
        bare[-1].write_text("\n".join(lines) + "\n")
    found = refit(bare, bare, FIT, Model.of(race()), tmp_path / "fit")
    assert set(found.before) == set(found.after) == set(AXES) and found.battery is None
    assert Model.from_json(json.loads(json.dumps(dataclasses.asdict(found)))) == found


def test_a_model_of_an_earlier_layout_is_refused():
    with pytest.raises(InputError, match=r"model\.json: written by another version"):
        Model.from_json({"model": {}, "battery": None}, Path("model.json"))
    earlier = {"constants": {}, "battery": None, "refused": "too large"}
    assert Model.from_json(earlier).rejection == "too large"


def test_refusals():
    assert rejected(ONES, dict.fromkeys(NAMES, 0.9)) == ""
    worse, better = (rejected(ONES, dict.fromkeys(NAMES, 1.0 + x)) for x in (0.03, -0.005))
    assert "is 3.0% larger than that of the present model, allowed: at least 1% smaller" in worse
    assert "is 0.5% smaller than that of the present model" in better
    harmful = dict.fromkeys(NAMES, 0.5) | {"Mz": 1.2}
    assert rejected(ONES, harmful) == "its error of Mz on held-out flights is 20% larger"
    without_speeds = dict.fromkeys(AXES, 1.0)
    assert rejected(without_speeds, dict.fromkeys(AXES, 0.9)) == ""


def test_the_training_has_the_model_and_the_numbers_at_the_end_of_the_schedules(tmp_path):
    scheduled = (
        "schedules={reward.gate_edge: {linear: [0, value]}, learner.std: {linear: [0.3, 0.1]}}"
    )
    config = race("reward.gate_edge=50", scheduled)
    battery = BatteryFit(0.07, 500.0, 2.0, {"a": 11800.0}, {"a": 11700.0})
    model = dataclasses.replace(Model.of(config), battery=battery)
    model = dataclasses.replace(model, constants=model.constants | {"k_w": 4e-8, "tau": 0.07})
    policy = policy_file(tmp_path)
    tuned = tuning_config(config, Round(policy, model, 0.1), None, 1000)
    assert tuned.vehicle.constants["k_w"] == 4e-8 and tuned.vehicle.constants["tau"] == 0.07
    assert tuned.reward.gate_edge == 50 and tuned.learner.std == 0.1
    assert tuned.reward.gate_edge_margin == 0.1
    (tmp_path / "config.yaml").write_text(tuned.to_yaml())
    assert load_config(tmp_path / "config.yaml").schedules == tuned.schedules  # to resume it
    assert set(tuned.schedules) == {"learner.learning_rate", "learner.critic_learning_rate"}
    assert tuned.battery.rpm_full > 11800.0 and tuned.observation.highest_rpm == "none"
    assert tuned.run.initial_policy == str(policy) and tuned.run.start_states is None


def flown(config, sideways=0.0, name="flight"):
    """The log of a path through the gates, ``sideways`` m off their centers."""
    position = around_the_track(config) + np.array([0.0, 0.0, sideways])
    count, nothing = len(position), np.zeros((len(position), 3))
    quantities = {"time": np.arange(count) / 100.0, "rpm": np.full((count, 4), 7000.0)}
    quantities |= {"gyro": nothing, "acceleration": nothing - [0.0, 0.0, 9.8]}
    quantities |= {"body_velocity": nothing + [1.0, 0.0, 0.0], "position": position}
    return log_flight(name, quantities | {"quaternion": Rotation.identity(count).as_quat()})


def test_logs_of_a_drone_that_turns_faster_than_the_policy_commands_are_refused():
    logs = [flown(race())]
    check_speeds(FitConfig(body=BodyConfig(rpm_range=(3000.0, 6000.0))), logs, "motor")
    slow = FitConfig(body=BodyConfig(rpm_range=(3000.0, 5000.0)))
    with pytest.raises(InputError, match="up to 7000 rpm, those of the vehicle are 3000 to 5000"):
        check_speeds(slow, logs, "motor")


def test_states_of_logs_are_starts_with_the_gate_ahead(tmp_path):
    config = race()
    states = states_of_logs([flown(config)], config)
    target = states.target
    assert len(states.time) == STATES and (np.diff(target) % 4 <= 1).all()
    np.testing.assert_allclose(np.bincount(target), STATES / 4, atol=2)
    save([states], tmp_path / "states.npz")
    state = Round(policy_file(tmp_path), Model.of(config), 0.0)
    tuned = tuning_config(config, state, tmp_path / "states.npz", 64)
    recorded = training_params(tuned).recorded
    np.testing.assert_allclose(recorded.motion.position.array(), states["position"], 1e-6)
    np.testing.assert_allclose(recorded.actuators, 0.0, atol=1e-6)
    log = flown(config)
    assert states_of_logs([log.with_signals(position=np.nan * log["position"])], config) is None


def test_the_margin_grows_with_hits_and_with_the_spread_of_the_clearance():
    config = race("reward.gate_edge=50", "reward.gate_edge_margin=0.05")
    half = 0.5 * config.track.gates[0].size[1]
    still = [flown(config)] * 2
    for values in clearances(still, config).values():
        np.testing.assert_allclose(values, half, atol=1e-6)
    assert margin_of(config, still, ()) == 0.05
    assert margin_of(config, still, ("a",)) == 0.1
    spread = [flown(config, offset * half) for offset in (0.7, 0.85, 0.95)]
    assert margin_of(config, spread, ()) > 0.1
    assert margin_of(race(), spread, ("a",)) == race().reward.gate_edge_margin


def test_the_spread_is_an_upper_bound_that_more_passages_lower():
    values = np.random.default_rng(0).normal(0.1, 0.04, (400, 4, 10))
    for count in (2, 4, 10):
        bounds = [spread_of(dict(enumerate(own[:, :count]))) for own in values]
        assert np.mean(np.array(bounds) > 0.04) == pytest.approx(0.9, abs=0.05)
    few, many = (spread_of({0: values[0, 0, :count]}) for count in (3, 10))
    assert few > many > values[0, 0].std()
    assert np.isnan(spread_of({0: np.array([0.1])})) and np.isnan(spread_of({}))


def test_a_flight_that_ends_at_a_gate_passes_it_outside_of_the_opening():
    config = race()
    gate = config.track.gates[1]
    whole = flown(config, 0.5 * gate.size[1] + 0.03)
    past = (whole["position"] - np.array(gate.position)) @ np.array(gate.axes)[:, 0] >= 0
    end = int(np.flatnonzero(past & (np.arange(len(past)) > 100))[0]) - 3
    log = whole.slice(slice(0, end))
    assert len(clearances([log], config)[0]) == 1 and 1 not in clearances([log], config)
    found = clearances([log], config, {"flight"})
    np.testing.assert_allclose(found[1], -0.03, atol=1e-3)
