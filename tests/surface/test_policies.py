"""Shipped policies and policy files: their laps, their old formats, their exported numbers."""

import json
from pathlib import Path

import numpy as np
import pytest

import quadjax
from tests.commands import run

TOTALS = {  # shipped policy: preset of its race, mean of ten deterministic flights, s
    "e2e_residual": ("e2e +residual", 13.93),
    "e2e_residual_disturbance": ("e2e +residual +disturbance", 14.24),
    "e2e_fastest": ("e2e +fastest", 12.87),
    "e2e": ("e2e", 14.00),
    "indi_fastest": ("indi +fastest", 16.28),
    "indi": ("indi", 17.89),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TOTALS)
def test_a_shipped_policy_flies_its_laps(name, tmp_path):
    preset, total = TOTALS[name]
    file = tmp_path / "laps.json"
    words = ("--policy", name, "--runs", 10, "--deterministic", "--json", file)
    assert run("evaluate", preset, *words) == 0
    laps = json.loads(file.read_text())
    assert laps["finished"] == laps["runs"] == 10 and not any(laps["crashes"])
    assert np.shape(laps["laps"]) == (10, 6)
    np.testing.assert_allclose(np.mean(laps["totals"]), total, atol=0.05)


def first_format(path: Path, **meta: object) -> Path:
    """A policy file as the first release wrote it: hover with a push forward."""
    rng = np.random.default_rng(0)
    document = {
        "format": "quadjax-policy/1",
        "vehicle": "motor",
        "activation": "relu",
        "output": "clip",
        "command_low": [3000.0] * 4,
        "command_high": [11000.0] * 4,
        "observation": {"wrap_next_yaw": True, "disturbance_input": "none", "disturbance": {}},
        "source": {"project": "quadjax"},
    } | meta
    np.savez(
        path,
        kernel_0=rng.standard_normal((24, 8)).astype(np.float32),
        bias_0=np.zeros(8, np.float32),
        kernel_1=rng.standard_normal((8, 4)).astype(np.float32),
        bias_1=np.zeros(4, np.float32),
        log_std=np.full(4, -1.0, np.float32),
        meta=json.dumps(document),
    )
    return path


def test_a_policy_file_of_the_first_release_is_read(tmp_path):
    path = first_format(tmp_path / "old.npz")
    policy = quadjax.Policy.load(path)
    assert policy.layout.size == 24
    x = np.random.default_rng(1).standard_normal((5, 24)).astype(np.float32)
    with np.load(path) as file:
        hidden = np.maximum(x @ file["kernel_0"], 0.0)
        reference = np.clip(hidden @ file["kernel_1"], -1.0, 1.0)
    np.testing.assert_allclose(policy.mean(x), reference, atol=1e-5)
    policy.save(tmp_path / "new.npz")
    again = quadjax.Policy.load(tmp_path / "new.npz")
    np.testing.assert_array_equal(again.mean(x), policy.mean(x))


def test_a_residual_file_of_the_first_release_is_read(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {}
    for name, sizes in {"thrust": (7, 8, 1), "moment": (10, 8, 3)}.items():
        for layer, shape in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            arrays[f"{name}_kernel_{layer}"] = rng.standard_normal(shape).astype(np.float32)
            arrays[f"{name}_bias_{layer}"] = np.zeros(shape[1], np.float32)
    meta = {"format": "quadjax-residual/1", "thrust_sign": 1, "rpm_min": 3000.0, "rpm_max": 11000.0}
    np.savez(tmp_path / "residual.npz", **arrays, meta=json.dumps(meta))
    config = quadjax.load("e2e", [f"vehicle.residual={tmp_path / 'residual.npz'}"])
    _, params = quadjax.make_race(config)
    assert params is not None
