from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.schema import Gate
from quadjax.evaluation import inputs
from quadjax.policy.pilot import Race
from quadjax.race.laps import Laps
from tests.evaluation.support import random_policy
from tests.race.support import BLANK

GATES = [Gate(position=(2.0, 0.0, -1.5)), Gate(position=(0.0, 2.0, -1.5), yaw_deg=90.0)]


def _trace(positions, targets):
    """One run; positions (time, 3), targets (time,)."""
    return SimpleNamespace(
        position=np.array(positions, np.float32)[:, :, None], target=np.array(targets)[:, None]
    )


def test_an_offset_is_measured_where_the_plane_is_crossed():
    # Half-way between two samples 0.3 m to the right of the first gate and level with it, then a
    # quarter of the way 0.4 m below the second one's centre and 0.1 m to the side.
    positions = [[1.9, 0.2, -1.5], [2.1, 0.4, -1.5], [0.1, 1.9, -1.1], [0.1, 2.3, -1.1]]
    found = inputs.gate_offsets(_trace(positions, [0, 1, 1, 0]), GATES)
    np.testing.assert_allclose(found, [0.3, 0.4], atol=1e-6)
    assert inputs.gate_offsets(_trace(positions, [0, 0, 0, 0]), GATES).size == 0


def test_every_input_flies_the_same_race(monkeypatch):
    flown = []

    def fly(config, policy, race, deterministic, trace, name):
        assert trace and not deterministic
        flown.append(config.at("observation.disturbance", "none"))
        word = config.observation.disturbance
        times = np.array([[2.0, 3.0], [2.0, np.nan if word == "none" else 2.0]])
        positions = np.array([[1.9, 0.1, -1.5], [2.1, 0.1, -1.5]])
        return Laps(times, ("", ""), np.zeros(2), 48.0), _trace(positions, [0, 1])

    monkeypatch.setattr(inputs, "fly_policy", fly)
    config = load_config(BLANK, [])
    results = inputs.compare(config, random_policy(), Race(2, 2, False), "file.npz")
    assert (
        set(results) == {"ground_truth", "estimated", "none"} and flown[0] == flown[1] == flown[2]
    )
    assert results["estimated"].finished == 2 and results["none"].finished == 1
    assert results["estimated"].seconds == pytest.approx(4.5)
    assert results["none"].seconds == pytest.approx(5.0)
    assert "1/2" in results["none"].row() and "5.00" in results["none"].row()


def test_nothing_passed_is_a_dash():
    assert inputs.InputResult(0, 3, None, None, None).row().split() == ["0/3", "-", "-", "-"]
