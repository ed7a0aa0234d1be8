"""Published times are shown only next to the race of the paper."""

import pytest

from quadjax.config.loading import load_config
from quadjax.core.resources import CONFIGS
from quadjax.training.paper import is_paper_race, published_rows, published_total
from tests.race.support import BLANK

FILES = [CONFIGS / f"{name}.yaml" for name in ("e2e_shac", "e2e_ppo", "e2e_paper", "indi_fastest")]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_presets_of_the_papers_race(path):
    assert is_paper_race(load_config(path))


@pytest.mark.parametrize(
    "word",
    [
        "rules.time_step=0.005",
        "rules.gate_test=world_box",
        "rules.position_limit=20",
        "rules.body_rate_limit=10",
        "track.file=figure8.yaml",
        "vehicle.constants.k_w=2e-7",
        "vehicle.constants.tau=0.05",
        "vehicle.integrator=rk4",
        "vehicle.residual=standin_residual.npz",
        "vehicle.mismatch={k_w: 0.96}",
        "randomization.inertia=0.1",
        "disturbance.force_z=0.1",
    ],
)
def test_any_other_race_has_no_published_time(word):
    config = load_config(CONFIGS / "e2e_shac.yaml", [word])
    assert published_rows(config, 6) == () and published_total(config) is None


def test_command_limits_of_the_rate_model_count():
    config = load_config(BLANK, ["vehicle.model=rate"])
    assert published_total(config)[1] == 17.04
    assert (
        published_total(load_config(BLANK, ["vehicle.model=rate", "vehicle.constants.r_max=2"]))
        is None
    )
