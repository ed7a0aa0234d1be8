"""The C of every choice of the observation: the inputs of the environment, and its verification."""

import numpy as np
import pytest

from quadjax.export import emulator
from quadjax.export.convert import export_c
from quadjax.export.states import observe
from quadjax.export.verify import run
from quadjax.export.verify.result import FAILED, PASSED
from tests.export.support import SIZES, fixed, library, made

EVERY_FIELD = list(SIZES)[:5]  # each kind of field once
FEW = [pytest.param(name, marks=pytest.mark.slow) for name in EVERY_FIELD[2:]]


@pytest.mark.parametrize("name", [*EVERY_FIELD[:2], *FEW])
def test_the_inputs_of_the_c_are_those_of_the_environment(name, tmp_path):
    own, policy, states, targets = fixed(name)
    network = policy.network
    q, status = emulator.observe(policy.race, states, targets)
    assert not status.any()
    found = q / 2.0**30 * network.box.ranges
    error = np.abs(found - observe(own, states, targets))
    assert error.max() < 2e-5 and np.abs(found).max(axis=0).min() > 0
    rows = library(policy, tmp_path).observe(states, targets)
    np.testing.assert_array_equal(rows[:, :-3], q)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["e2e with a history", "indi and more"])
def test_an_exported_folder_passes_its_verification(name, tmp_path):
    policy, _ = made(name)
    policy.save(tmp_path / "policy.npz")
    wide = {"position": 64.0, "velocity": 128.0, "rates": 1024.0, "attitude": 4.0}
    ranges = {key: value for key, value in wide.items() if key in policy.layout}
    out = tmp_path / "c"
    export_c(tmp_path / "policy.npz", out, ranges=ranges, name="made", allow_unfinished=True)
    assert (out / "paparazzi").exists() == (policy.vehicle != "racing")
    only = ("range proof", "NumPy = C", "simulator", "processor", "estimators")
    results = {r.check: r for r in run.verify(out, 1000, only=only)}
    assert all(r.verdict != FAILED for r in results.values()), results
    assert all(results[name].verdict == PASSED for name in only[:3])
