"""Several seeds in one program on a GPU: each trains as it does alone."""

import numpy as np
import pytest

import quadjax
from benchmarks.seeds_at_once import seeds_at_once
from tests.surface.short import short, short_config


@pytest.mark.slow
def test_each_seed_trains_as_it_does_alone(tmp_path):
    seeds_at_once(*short("e2e_ppo"), seeds=(3, 4), output=tmp_path)
    config = short_config("e2e_ppo", "seed=4")
    alone = quadjax.train(config, tmp_path / "alone", progress=False)
    together = quadjax.Run.load(tmp_path / "e2e_ppo_seed4")
    assert together.finished and together.summary["steps"] == alone.summary["steps"] == 512
    for name in ("reward", "value_loss", "approx_kl"):
        np.testing.assert_allclose(
            together.metrics[name][0], alone.metrics[name][0], rtol=1e-3, err_msg=name
        )
    other = quadjax.Run.load(tmp_path / "e2e_ppo_seed3")
    assert abs(other.metrics["reward"][0] - together.metrics["reward"][0]) > 1e-4
