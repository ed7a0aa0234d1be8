"""Published times are shown only next to flights of the same race and protocol."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.evaluation import published
from quadjax.evaluation.evaluate import evaluate
from quadjax.plant.config import load_plant_config
from quadjax.vehicle.residual import digest, read_residual, write_residual
from tests.evaluation.support import random_policy


@pytest.fixture
def residual(tmp_path, monkeypatch):
    """A residual that takes the place of the authors', as an override."""
    own = read_residual("standin_residual.npz").replace(rpm_max=np.float32(11500.0))
    write_residual(tmp_path / "theirs.npz", own, {})
    monkeypatch.setattr(published, "RESIDUAL", digest(own))
    return f"vehicle.residual={tmp_path / 'theirs.npz'}"


def e2e(*overrides, preset="e2e_table1"):
    return load_config(preset, overrides)


def indi(*overrides):
    return load_config("indi_table1", overrides)


def total(config):
    row = published.published_row(config)
    return row and round(row.total, 2)


def test_each_row_has_the_race_of_its_preset(residual):
    assert (total(e2e(residual)), total(indi())) == (15.75, 17.14)
    for row in (published.E2E, published.INDI):
        assert sum(row.lap_means) == pytest.approx(row.total)


OTHER_E2E = """
rules.time_step=0.005
rules.gate_test=world_box
rules.position_limit=20
track.file=figure8.yaml
track.opening=1.001
vehicle.constants.k_w=4.4e-8
vehicle.integrator=rk4
vehicle.quaternion=true
vehicle.residual_gain=0.99
vehicle.residual=standin_residual.npz
vehicle.residual=null
vehicle.residual=removed.npz
vehicle.mismatch={k_w: 0.96}
randomization.inertia=0.1
disturbance.force_z=0.1
disturbance.moment_bias=[0, 0.01, 0]
battery={}
"""
OTHER_INDI = ("vehicle.constants.thrust_max=15", "vehicle.constants.r_max=3")
OTHERS = ("e2e +residual", "e2e_ppo", "indi +fastest", "indi", "indi_paper", "e2e_paper")


def test_any_other_race_has_no_published_time(residual):
    for word in OTHER_E2E.strip().splitlines():
        assert total(e2e(residual, word)) is None, word
    for word in OTHER_INDI:
        assert total(indi(word)) is None, word
    for preset in OTHERS:
        config = load_config(preset)
        assert total(config) is None and published.published_total(config) is None, preset


def test_training_does_not_matter_to_timed_flights(residual):
    """Rewards, starts and limits of training, and whole turns of a gate."""
    own = ["reward.time=1", "start.position=1", "training_limits.pitch_deg=60", "start.gate=random"]
    assert total(indi(*own)) == 17.14
    assert total(e2e(residual, preset="e2e")) == 15.75
    gates = [gate.replace(yaw_deg=gate.yaw_deg - 360.0) for gate in indi().track.gates]
    assert total(indi().replace(track=indi().track.replace(gates=gates))) == 17.14
    terms = indi().reward.replace(terms={"no_such_module:term": 1.0})  # which is not imported
    assert total(indi().replace(reward=terms)) == 17.14


@pytest.mark.parametrize(
    ("protocol", "beside"),
    [
        ({}, True),
        ({"deterministic": True}, False),
        ({"start": "random"}, False),
        ({"laps": 5}, False),
        ({"gates": 24}, False),
    ],
)
def test_another_protocol_has_no_published_time(protocol, beside, monkeypatch):
    """The flights are not simulated: only their row matters."""
    laps = published.INDI.laps
    monkeypatch.setattr("quadjax.race.laps.fly_race", lambda *_: (None, None))
    monkeypatch.setattr("quadjax.race.laps.laps_of", lambda *_: laps)
    result = evaluate(random_policy("rate"), indi(), **protocol)
    assert (result.row.published is published.INDI) == beside
    assert ("published" in result.table()) == beside


@pytest.mark.parametrize(
    ("words", "beside"),
    [
        ([], True),
        (["drone=3"], True),
        (["name=mine"], True),
        (["effects.gusts=0"], False),
        (["inner_loop=indi"], False),
        ([f"population={{effects.gusts: {[0] * 20}}}"], False),
    ],
)
def test_the_real_flights_are_beside_those_of_the_plant_of_that_drone(words, beside):
    for config, row in ((e2e("vehicle.residual=null"), "motor"), (indi(), "rate")):
        found = published.flown_row(config, load_plant_config("cyberzoo", words), 6)
        assert found is (published.FLOWN[row] if beside else None)


def test_other_plants_and_lengths_have_no_real_flights():
    assert published.flown_row(indi(), load_plant_config("cyberzoo"), 5) is None
    assert published.flown_row(indi(), load_plant_config("standin", ["name=cyberzoo"]), 6) is None


def test_training_compares_sampled_scores_only():
    assert indi().run.score == "mean" and published.published_total(indi()) is None
    assert published.published_total(load_config("e2e")) is None
    _, time = published.published_total(indi("run.score=sampled"))
    metrics = {"lap_total": np.array([np.inf, 18.0, 17.0, 16.0])}
    metrics |= {"seconds": np.arange(4.0), "steps": 500.0 * np.arange(4)}
    assert published.first_under(metrics, time) == (2.0, 1000)
    assert published.first_under(metrics, 10.0) is None


def test_a_residual_that_is_not_there_says_how_to_import_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"bebop1_residual.npz: no such file.*quadjax import") as e:
        evaluate(random_policy(), load_config("e2e_table1"), runs=1)
    assert "\n" not in str(e.value)
