"""Runs in one program are the runs by themselves."""

import dataclasses

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.policy.file import write_policy
from quadjax.race.build import build_params
from quadjax.sweeps import locks, together
from quadjax.training import many
from quadjax.training import run as training
from quadjax.training.build import build_learner, initial_policy, policy_of, start_state
from quadjax.training.metrics import read_metrics
from tests.sweeps.support import ROOT, TINY, open_store

WORDS = [
    "train.drones=16",
    "network.hidden=[8]",
    "ppo.steps_per_update=8",
    "ppo.batches=2",
    "ppo.epochs=1",
    "shac.horizon=4",
    "evaluate.laps=1",
    "train.steps=256",
    "train.evaluate_every=128",
    "train.devices=1",
]
OWN = [
    ["seed=0", "ppo.learning_rate=1e-3", "shac.std=0.4", "reward.gate=10"],
    ["seed=3", "ppo.learning_rate=3e-3", "shac.std=0.2", "reward.gate=5", "network.log_std=-0.5"],
]


def arrays(path):
    with np.load(path) as archive:
        return {name: archive[name] for name in archive.files if name != "meta"}


@pytest.mark.parametrize("name", ["e2e_ppo.yaml", "e2e_shac.yaml"])
def test_vmapped_runs_equal_separate_ones(tmp_path, name):
    configs = [load_config(ROOT / "configs" / name, [*WORDS, *own]) for own in OWN]
    assert many.shape_of(configs[0]) == many.shape_of(configs[1])
    folders = [tmp_path / f"together{i}" for i in range(2)]
    results = many.train_many(configs, folders, lambda rows: False, lambda: False)
    assert all(result.finished for result in results)
    for config, folder in zip(configs, folders, strict=True):
        training.train(config, tmp_path / f"alone{config.seed}")
        alone = arrays(tmp_path / f"alone{config.seed}" / "policy_last.npz")
        for key, value in arrays(folder / "policy_last.npz").items():
            np.testing.assert_allclose(value, alone[key], atol=2e-5, err_msg=key)
        wanted = read_metrics(tmp_path / f"alone{config.seed}" / "metrics.csv")
        found = read_metrics(folder / "metrics.csv")
        for key in ("reward", "policy_loss", "value_loss", "lap_total", "steps"):
            np.testing.assert_allclose(found[key], wanted[key], rtol=2e-3, atol=2e-5, err_msg=key)
    first, second = (arrays(folder / "policy_last.npz") for folder in folders)
    assert any(np.abs(first[key] - second[key]).max() > 1e-2 for key in first)


@pytest.mark.parametrize("name", ["e2e_ppo.yaml", "e2e_shac.yaml"])
def test_runs_from_a_file_begin_together_as_they_do_alone(tmp_path, name):
    base = load_config(ROOT / "configs" / name, [*WORDS, *OWN[0]])
    donor = start_state(base, build_learner(base), build_params(base))
    write_policy(tmp_path / "p.npz", policy_of(base, donor.params, {}))
    words = [*WORDS, f"train.init={tmp_path / 'p.npz'}"]
    configs = [load_config(ROOT / "configs" / name, [*words, *own]) for own in OWN]
    learner, params = build_learner(configs[0]), [build_params(config) for config in configs]
    together = many.start_states(configs, learner, params)
    for index, config in enumerate(configs):
        alone = start_state(config, build_learner(config), params[index], initial_policy(config))
        for part in ("params", "target", "ema"):
            wanted = jax.tree.leaves(getattr(alone, part))
            found = jax.tree.leaves(getattr(together, part))
            for a, b in zip(wanted, found, strict=True):
                np.testing.assert_allclose(b[index], a, rtol=1e-6, atol=1e-7)


def test_what_fixes_shapes_or_code_is_not_shared():
    base = load_config(ROOT / "configs" / "e2e_ppo.yaml", WORDS)
    for word in (
        "network.hidden=[9]",
        "ppo.epochs=2",
        "episode.random_gate=false",
        "train.drones=32",
    ):
        other = load_config(ROOT / "configs" / "e2e_ppo.yaml", [*WORDS, word])
        assert many.shape_of(other) != many.shape_of(base), word


def test_trials_run_together(tmp_path):
    space = {"ppo.learning_rate": {"log": [1e-4, 1e-2]}, "network.hidden": {"choices": [[8], [9]]}}
    opened = open_store(
        tmp_path,
        space=space,
        overrides={k: v for k, v in TINY.items() if k != "network.hidden"},
        objective={"seeds": 2, "flights": 2},
        budget={"trials": 3},
    )
    claims = [opened.claim(locks.this_worker()) for _ in range(3)]
    jobs = together._jobs(opened, claims)
    groups = together._groups(jobs, 4)
    assert sum(len(group) for group in groups) == 6
    for group in groups:
        assert len(group) <= 4 and len({many.shape_of(job.config) for job in group}) == 1
    assert together.run_trials(opened, claims, 4, lambda: False)
    assert opened.counts().done == 3
    assert all(len(t.user_attrs["values"]) == 2 for t in opened.trials())


def test_a_run_that_is_not_finite_ends_alone(tmp_path):
    config = load_config(ROOT / "configs" / "e2e_ppo.yaml", [*WORDS, "seed=1"])
    bad = dataclasses.replace(config, reward=dataclasses.replace(config.reward, progress=np.inf))
    results = many.train_many(
        [config, bad], [tmp_path / "a", tmp_path / "b"], lambda rows: False, lambda: False
    )
    assert results[0].finished and isinstance(results[1], many.NonFiniteError)
