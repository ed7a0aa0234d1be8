"""Several trainings in one program on a GPU: each trains as it does alone."""

import numpy as np
import pytest

import quadjax
from benchmarks.at_once import at_once
from tests.surface.short import short, short_config

TRACKS = "track.generate.seed=1", "track.generate.seed=3"  # of other bounds


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "each", "name"),
    [("e2e_ppo", (), "e2e_ppo"), ("e2e_race", TRACKS, "e2e_race_3")],
)
def test_each_training_is_as_alone(tmp_path, preset, each, name):
    at_once(*short(preset), seeds=(3, 4), each=each, output=tmp_path)
    config = short_config(preset, "seed=4", *each[1:])
    alone = quadjax.train(config, tmp_path / "alone", progress=False)
    together = quadjax.Run.load(tmp_path / f"{name}_seed4")
    assert together.finished and together.summary["steps"] == alone.summary["steps"] == 512
    for metric in set(alone.metrics) & {"reward", "value_loss", "approx_kl", "policy_loss"}:
        np.testing.assert_allclose(
            together.metrics[metric][0], alone.metrics[metric][0], rtol=1e-3, err_msg=metric
        )
    other = quadjax.Run.load(tmp_path / f"{name}_seed3")
    assert abs(other.metrics["reward"][0] - together.metrics["reward"][0]) > 1e-4
