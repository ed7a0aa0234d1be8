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


def test_what_is_printed_of_a_result_is_one_line():
    laps = quadjax.evaluate("indi", "indi", laps=1, runs=2)
    assert repr(laps) == "Evaluation(indi sampled, 2 runs: 2/2 finished)"
    found = repr(laps.flights[0])
    samples, gates = len(laps.flights[0].time), len(laps.flights[0].passages)
    seconds = laps.flights[0].time[-1]
    assert found == (
        f"Flight('run 1': {samples} samples of {seconds:.2f} s, {gates} gates passed, 1 laps)"
    )
    assert repr(quadjax.Policy.load("e2e")) == ("Policy(24-64-64-64-4, relu, vehicle model motor)")


def test_every_public_name_exists_and_is_documented():
    for name in quadjax.__all__:
        assert name in dir(quadjax)
        value = getattr(quadjax, name)
        assert isinstance(value, str) or value.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        quadjax.fly  # noqa: B018
    assert {"e2e", "e2e_race", "indi"} <= set(quadjax.presets())
    pages = [ROOT / "docs" / "reference" / f"{page}.md" for page in ("api", "interfaces")]
    named = "".join(page.read_text() for page in pages)
    assert [name for name in quadjax.__all__ if name not in named] == ["__version__"]
    assert issubclass(quadjax.InputWarning, UserWarning)


@pytest.mark.slow
def test_a_shipped_policy_is_evaluated(tmp_path):
    config = quadjax.load("e2e", ["evaluate.laps=1"])
    laps = quadjax.evaluate(PRETRAINED / "e2e.npz", config, runs=3)
    assert laps.lap_times.shape == (3, 1) and laps.finished == 3
    assert "sampled, 3 runs" in laps.table() and "3/3" in laps.table()
    assert np.all((laps.totals > 2.0) & (laps.totals < 4.0))
    again = quadjax.evaluate(PRETRAINED / "e2e.npz", config, runs=3)
    np.testing.assert_array_equal(again.totals, laps.totals)
    other = quadjax.evaluate(PRETRAINED / "e2e.npz", config, runs=3, seed=1)
    assert not np.array_equal(other.totals, laps.totals)
    flown = laps.to_json()
    origin = flown["provenance"]
    assert flown["runs"] == 3 and origin["config"]["name"] == "e2e" and origin["seed"] == 0
    assert origin["policy"]["file"].endswith("e2e.npz") and origin["policy"]["sha256"]
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


def test_wrong_arguments_are_one_line(tmp_path):
    (tmp_path / ".quadjax.json").write_text('{"kind": "sweep"}')
    policy = PRETRAINED / "e2e.npz"
    for call, message in (
        (lambda: quadjax.evaluate(policy, "e2e", runs=2.5), "runs is 2.5, allowed: a whole number"),
        (lambda: quadjax.evaluate(policy, "e2e", start="moon"), "start is 'moon'"),
        (lambda: quadjax.SHAC(horizon=0), "SHAC: horizon is 0, allowed: greater than or eq"),
        (lambda: quadjax.train("e2e", tmp_path), "holds a sweep, not a run"),
        (lambda: quadjax.load("e2e_shak"), "e2e_shak"),
        (lambda: quadjax.Policy.load("nominl.npz"), "nominl.npz: no such file, .* e2e_residual"),
    ):
        with pytest.raises(quadjax.InputError, match=message):
            call()
