"""The public names of quadjax: lazy, complete, and used as the README uses them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import quadjax
from quadjax.core.resources import PRETRAINED

ROOT = Path(__file__).resolve().parent.parent


def test_importing_quadjax_is_fast_and_imports_neither_jax_nor_numpy():
    code = (
        "import sys, time; t = time.perf_counter(); import quadjax; quadjax.presets();"
        "print(time.perf_counter() - t, 'jax' in sys.modules, 'numpy' in sys.modules)"
    )
    command = [sys.executable, "-c", code]
    seconds = []
    for _ in range(3):  # the fastest counts: others may be using the machine
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
        spent, *heavy = done.stdout.split()
        assert heavy == ["False", "False"]
        seconds.append(float(spent))
    assert min(seconds) < 0.3


def test_every_public_name_exists_and_is_documented():
    for name in quadjax.__all__:
        assert name in dir(quadjax)
        value = getattr(quadjax, name)
        assert isinstance(value, str) or value.__doc__, name


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        quadjax.fly  # noqa: B018


def test_presets_can_be_loaded_by_name():
    assert {"e2e", "e2e_race", "indi"} <= set(quadjax.presets())
    config = quadjax.load("e2e", ["seed=3"])
    assert isinstance(config, quadjax.Config) and (config.name, config.seed) == ("e2e", 3)
    with pytest.raises(quadjax.InputError, match="e2e_shak"):
        quadjax.load("e2e_shak")


def test_shipped_policies_are_found_by_name():
    first, second = (quadjax.Policy.load(name) for name in ("e2e_nominal", "e2e_nominal.npz"))
    np.testing.assert_array_equal(first.log_std, second.log_std)
    with pytest.raises(quadjax.InputError, match="e2e_nominl.npz: no such file, .* e2e_nominal"):
        quadjax.Policy.load("e2e_nominl.npz")


@pytest.mark.slow
def test_a_shipped_policy_is_evaluated(tmp_path):
    config = quadjax.load("e2e", ["evaluate.laps=1"])
    laps = quadjax.evaluate(PRETRAINED / "e2e_nominal.npz", config, runs=3)
    assert laps.lap_times.shape == (3, 1) and laps.finished == 3
    assert "sampled, 3 runs" in laps.table() and "3/3" in laps.table()
    assert np.all((laps.totals > 2.0) & (laps.totals < 4.0))
    again = quadjax.evaluate(PRETRAINED / "e2e_nominal.npz", config, runs=3)
    np.testing.assert_array_equal(again.totals, laps.totals)
    other = quadjax.evaluate(PRETRAINED / "e2e_nominal.npz", config, runs=3, seed=1)
    assert not np.array_equal(other.totals, laps.totals)
    flown = laps.to_json()
    origin = flown["provenance"]
    assert flown["runs"] == 3 and origin["config"]["name"] == "e2e" and origin["seed"] == 0
    assert origin["policy"]["file"].endswith("e2e_nominal.npz") and origin["policy"]["sha256"]
    flight = laps.best
    assert flight.lap_ends[-1] == pytest.approx(np.nanmin(laps.totals), abs=0.011)
    laps.save_states(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz", allow_pickle=False) as states:
        assert states["position"].shape == (*states["time"].shape, 3) and len(states["time"]) == 3
        assert np.isfinite(states["velocity"][0, 0]).all() and states["actuators"].shape[2] == 4
        np.testing.assert_array_equal(states["lap_ends"], laps.lap_times)
    with pytest.raises(quadjax.InputError, match=r"states.txt: suffix is '.txt'"):
        laps.save_states(tmp_path / "states.txt")
    laps.plot().savefig(tmp_path / "lap.png")
    assert (tmp_path / "lap.png").stat().st_size > 10_000


def test_a_number_out_of_range_is_one_line():
    policy = PRETRAINED / "e2e_nominal.npz"
    for argument, message in (
        ({"runs": 2.5}, "runs is 2.5, allowed: a whole number"),
        ({"start": "moon"}, "start is 'moon'"),
    ):
        with pytest.raises(quadjax.InputError, match=message):
            quadjax.evaluate(policy, "e2e", **argument)
    with pytest.raises(quadjax.InputError, match="SHAC: horizon is 0, allowed: greater than or eq"):
        quadjax.SHAC(horizon=0)


def test_a_preset_is_trained_by_its_name(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".quadjax.json").write_text('{"kind": "sweep"}')
    with pytest.raises(quadjax.InputError, match="holds a sweep, not a run"):
        quadjax.train("e2e", tmp_path / "run")
