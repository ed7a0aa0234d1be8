"""Several seeds of one config, trained, flown and tabulated."""

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.evaluation import seeds
from quadjax.evaluation.conditions import read_conditions
from quadjax.evaluation.evaluate import Evaluation
from quadjax.evaluation.rows import Row
from quadjax.evaluation.seeds import configs_of, train_once
from tests.evaluation.test_laps import flights
from tests.surface.short import OF_EACH, OF_LEARNER
from tests.test_training import CONFIGS

TINY = [*OF_EACH, *OF_LEARNER["ppo"]]
CONFIG = str(CONFIGS / "e2e_ppo.yaml")


@pytest.mark.slow
def test_a_seed_is_trained_once_and_not_passed_off_as_another(tmp_path):
    words = [*TINY, "seed=3", "name=mine"]
    folder = train_once(CONFIG, words, tmp_path)
    before = (folder / "summary.json").stat().st_mtime_ns
    assert train_once(CONFIG, words, tmp_path) == folder
    assert (folder / "summary.json").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="discount"):
        train_once(CONFIG, [*words, "learner.discount=0.9"], tmp_path)
    result = seeds.evaluate_seed(folder, 2)
    assert result.seed == 3 and result.steps == 512
    assert [row["runs"] for row in result.to_json()["flights"]] == [2] * 4
    for table in seeds.format_seeds([result]).split("\n\n")[:2]:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert result.reference is None and "at s |" not in table  # one lap has no published time


def test_the_table_names_the_published_time():
    numbers = {field: 1.0 for field in seeds.SeedResult.__dataclass_fields__}
    rows = (Row("seed 2", flights(2.0), "mean"),)
    listed = read_conditions("protocols")
    flown = Evaluation(rows, listed, {"policy": {"file": "a"}}, (), True)
    given = {"reference": 17.14, "seed": 2, "last": None, "flights": flown}
    result = seeds.SeedResult(**numbers | given)
    head, _, row = seeds.format_seeds([result]).split("\n\n")[0].splitlines()
    assert "<17.14 at s" in head and "| 2 |" in row and "| - |" in row
    assert np.isfinite(result.best)


@pytest.mark.slow
def test_a_training_that_fails_is_one_line(tmp_path):
    with pytest.raises(InputError, match="e2e_ppo failed with status 2"):
        train_once(CONFIG, [*TINY, "run.initial_policy=none.npz"], tmp_path)


def test_configs_have_names_that_differ():
    files = [str(CONFIGS / name) for name in ("e2e_ppo.yaml", "indi_ppo.yaml")]
    configs = configs_of(files, ["learner.num_epochs=2"])
    assert list(configs) == ["e2e_ppo", "indi_ppo"]
    assert all(config.learner.num_epochs == 2 for config in configs.values())
    assert list(configs_of(["e2e", "e2e +fastest name=other"], [])) == ["e2e", "other"]
    with pytest.raises(InputError, match="named mine"):
        configs_of(files, ["name=mine"])
