"""A short training ends with a policy that flies laps."""

import numpy as np
import pytest

import quadjax

pytestmark = pytest.mark.slow
TRACK = """
name: wide
gates:
  - {position: [2.0, -1.5, -2.0], yaw_deg: 45.0, size: [3.0, 3.0]}
  - {position: [2.0, 1.5, -2.0], yaw_deg: 135.0, size: [3.0, 3.0]}
  - {position: [-2.0, 1.5, -2.0], yaw_deg: 225.0, size: [3.0, 3.0]}
  - {position: [-2.0, -1.5, -2.0], yaw_deg: 315.0, size: [3.0, 3.0]}
"""


def test_a_policy_flies_after_two_million_steps(tmp_path, optimized):
    (tmp_path / "wide.yaml").write_text(TRACK, encoding="utf-8")
    overrides = [
        f"track={tmp_path / 'wide.yaml'}",
        "start.heading=north",
        "training_limits.gate_inflation=0",
        "reward.gate_edge=0",
        "schedules=null",
        "run.steps=2000000",
        "run.evaluate_every=500000",
        "run.devices=1",
        "evaluate.best_known_lap=2.0",
    ]
    config = quadjax.load("e2e", overrides)
    run = quadjax.train(config, folder=tmp_path / "run")
    laps = quadjax.evaluate(run.policy, config, laps=2, runs=3, deterministic=True)
    assert np.all(np.isfinite(laps.totals))
    assert np.max(laps.lap_times) < 5.0  # s; it flies 3 s
    best = run.metrics["best_lap_total"][-1] / config.evaluate.laps  # with the standing start
    gaps = run.metrics["gap"]
    assert np.isinf(gaps[0]) or gaps[0] > gaps[-1]
    assert 0.0 < np.min(gaps) < best / 2.0 - 1.0
