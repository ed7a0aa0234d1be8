"""The scripts behind the numbers of the documentation."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import rows, speed
from benchmarks.best_laps import read_best
from benchmarks.drones import draw_drones, reachable
from benchmarks.probe import quantities, r_squared
from benchmarks.ship import median_of, trained
from benchmarks.tracks import cell
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.training.checkpoint import RunState
from quadjax.training.result import write_summary
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.registry import base_model
from tests.race.support import BLANK
from tests.scripts import run_script


def test_probes_of_known_inputs_have_the_known_r_squared():
    random = np.random.default_rng(0)
    drone, ratio = np.repeat(np.arange(1200), 3), random.normal(2.0, 0.3, 1200)
    seen, noise = ratio[drone], random.normal(0.0, 0.3, (4, 3600))
    exact = np.stack([7.0 - 100.0 * seen, noise[0], np.ones_like(seen)], 1)
    assert r_squared(drone, exact, ratio) > 0.9999
    noisy = np.stack([seen + noise[1] / np.sqrt(3.0), noise[2]], 1)
    assert r_squared(drone, noisy, ratio) == pytest.approx(0.75, abs=0.03)
    assert abs(r_squared(drone, noise[2:].T, ratio)) < 0.02
    assert r_squared(drone, np.eye(1200)[drone], ratio) < 0.02  # it tells the fitted drones only


def test_the_median_ships_unless_it_finishes_too_few_flights():
    times = [14.0, 13.9, 14.1, float("nan")]
    assert median_of(times, [True] * 4) == 0
    assert median_of(times, [False, True, True, False]) == 1  # the first of two as near
    with pytest.raises(InputError, match="no training finishes often enough"):
        median_of(times, [False] * 4)


def test_a_step_is_known_by_its_flights(monkeypatch):
    """Of a step with two seeds, one flight of four does not finish."""
    lap, none = [1.0, 2.0], [None, None]
    parts = {"step": "INDI", "config": ["indi"], "commit": "abc"}
    steps = [
        parts | {"seeds": [1], "laps": [[lap, [2.0, 2.0]]]},
        parts | {"seeds": [0], "laps": [[lap, none]]},
    ]
    monkeypatch.setattr(rows, "read", lambda name: steps if name == "interventions" else [])
    (first, second), least = trained("INDI")
    assert (first.seed, first.time, first.share, least) == (0, 3.0, 0.5, 0.98)
    assert (second.seed, second.time, second.share) == (1, 3.5, 1.0)
    with pytest.raises(InputError, match="E2E: no such row"):
        trained("E2E")


def test_limits_of_the_commands_are_within_the_nominal_range():
    drawn = {}
    for overrides in ((), ("vehicle=5inch",)):
        config = load_config(BLANK, overrides)
        kind = base_model(config.vehicle.model)
        nominal = kind.make_constants(config.vehicle.constants)
        factors = jnp.array([0.9, 1.2])
        wide = kind.make_constants({k: x * factors for k, x in values_of(nominal).items()})
        drawn[kind.name] = reachable(kind, nominal, wide), nominal
    found, nominal = drawn["motor"]
    np.testing.assert_allclose(found.rpm_max, nominal.rpm_max * np.array([0.9, 1.0]))
    np.testing.assert_allclose(found.rpm_min, nominal.rpm_min * np.array([1.0, 1.2]))
    found, nominal = drawn["racing"]
    np.testing.assert_allclose(found.w_max, nominal.w_max * np.array([0.9, 1.2]), rtol=1e-6)
    ratio = quantities(base_model("racing"), found)["thrust to weight"]
    # Thrust coefficient and square of the speed have the factor; so has gravity.
    np.testing.assert_allclose(ratio, 10.98 * np.array([0.9, 1.2]) ** 2, rtol=0.01)


def test_best_laps_are_a_file_and_runs_a_median_with_their_range(tmp_path):
    some = np.array([3.04, np.nan, 1.0, 2.0])
    assert cell(some, 1) == "2.0 (1.0-3.0), 3 of 4"
    assert (cell(some[2:3], 2), cell(some[1:2], 1)) == ("1.00", "-")
    shipped = read_best("best_known")
    assert shipped["square4", "bebop1"].seconds == 2.0385
    assert all(lap.source for lap in shipped.values())
    file, lap = tmp_path / "mine.yaml", "{track: a, vehicle: b, seconds: 3.0, source: mine}"
    file.write_text(f"laps: [{lap}, {lap}]\n")
    with pytest.raises(InputError, match="two laps of a with b, allowed: one"):
        read_best(file)


@pytest.mark.slow
def test_drawn_drones_are_vehicle_files(tmp_path, capsys):
    draw = ["--count", "2", "--seed", "3", "--output", str(tmp_path)]
    assert run_script("drones", BLANK, "randomization.all=0.2", *draw) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    drawn = draw_drones(load_config(BLANK, ["randomization.all=0.2"]), 8, 3)
    for index in range(2):  # the first two are possible bodies
        file = tmp_path / f"drone_3_{index}.yaml"
        constants = load_config(BLANK, [f"vehicle={file}"]).vehicle.constants
        for name, value in constants.items():
            assert value == pytest.approx(float(getattr(drawn, name)[index]), rel=1e-5)
    assert run_script("drones", BLANK, *draw) == 2
    assert "randomization draws no constants" in capsys.readouterr().err


@pytest.mark.slow
def test_scripts_print_their_tables(tmp_path, monkeypatch, capsys):
    policy = str(PRETRAINED / "e2e_fastest.npz")
    config = load_config("e2e +fastest")
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    run = RunState(None, None, steps=1)
    write_summary(config, tmp_path, run, 1, True)
    shutil.copy(policy, tmp_path / "policy.npz")
    assert run_script("tracks", str(tmp_path), str(tmp_path)) == 0
    assert "| motor | square4 | Parrot Bebop 1 | 1 | 2.0" in capsys.readouterr().out
    few = ["--policy", policy, "--drones", "40", "--seconds", "2"]
    assert run_script("probe", "e2e +fastest", "randomization.all=0.2", *few) == 0
    assert "| layer 2 |" in capsys.readouterr().out
    monkeypatch.setattr(speed, "STEPS_PER_CALL", 100)
    assert "steps/s" in speed.measure("observed", "bebop1", "2", 1)


@pytest.mark.slow
def test_throws_are_caught_only_after_training(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "RESULTS", tmp_path)
    monkeypatch.setattr(rows, "commit", lambda: "1234567")
    for steps in (512, 450_000):
        words = [f"run.steps={steps}", f"run.evaluate_every={steps}", "--throws", "200"]
        assert run_script("hover", *words, "--output", tmp_path / str(steps)) == 0
    (few,), (many,) = (row["caught, %"] for row in rows.read("hover"))
    assert few == 0.0 and many > 90.0
