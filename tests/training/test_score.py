"""The score by which the best policy of a training is chosen."""

import numpy as np
import pytest

from quadjax.race.laps import Laps
from quadjax.training import score
from tests.surface.short import short_config


@pytest.mark.parametrize(("kind", "count"), [("mean", 1), ("sampled", 16)])
def test_the_flights_of_a_score(kind, count, monkeypatch):
    """Of the mean action, or with the noise of training, as ``run.score`` says."""
    calls = []

    def fly(choices, params, act, policy, key, laps, runs, gates):
        calls.append((act, runs))
        return Laps(np.full((runs, 1), 2.0), ("",) * runs, np.full(runs, 2.0), 8.0), None

    monkeypatch.setattr(score, "fly_laps", fly)
    monkeypatch.setattr(score, "network_policy", lambda config, params: params)
    config = short_config("e2e", f"run.score={kind}")
    assert score.make_flights(config, params=None)(np.zeros(1)).score == 2.0
    expected = {"mean": score.act_deterministic, "sampled": score.act_sampled}
    assert calls == [(expected[kind], count)]
