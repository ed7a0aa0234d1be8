"""Shipped policies fly their laps; policy and residual files that NumPy wrote are used."""

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


RPM = {"name": "rpm", "size": 4, "unit": "rpm", "frame": "body", "span": [[3000.0, 11000.0]] * 4}
FIELDS = (  # without moment_ext and force_ext, which a policy need not observe
    {"name": "position", "size": 3, "unit": "m", "frame": "gate"},
    {"name": "velocity", "size": 3, "unit": "m/s", "frame": "gate"},
    {"name": "attitude", "size": 3, "unit": "rad", "frame": "gate"},
    {"name": "rates", "size": 3, "unit": "rad/s", "frame": "body"},
    RPM,
    {"name": "next_position", "size": 3, "unit": "m", "frame": "gate"},
    {"name": "next_yaw", "size": 1, "unit": "rad", "frame": "gate"},
)


def own_policy(path: Path) -> Path:
    """A policy file written with NumPy alone, with no more than a policy file must have."""
    rng = np.random.default_rng(0)
    meta = {
        "format": "quadjax-policy/2",
        "vehicle": "motor",
        "activation": "relu",
        "command_low": [3000.0] * 4,
        "command_high": [11000.0] * 4,
        "layout": FIELDS,
    }
    np.savez(
        path,
        kernel_0=rng.standard_normal((20, 8)).astype(np.float32),
        bias_0=np.zeros(8, np.float32),
        kernel_1=rng.standard_normal((8, 4)).astype(np.float32),
        bias_1=np.zeros(4, np.float32),
        log_std=np.full(4, -1.0, np.float32),
        meta=json.dumps(meta),
    )
    return path


def test_a_policy_file_of_numpy_alone(tmp_path):
    path = own_policy(tmp_path / "own.npz")
    policy = quadjax.Policy.load(path)
    x = np.random.default_rng(1).standard_normal((5, 20)).astype(np.float32)
    with np.load(path) as file:
        hidden = np.maximum(x @ file["kernel_0"], 0.0)
        reference = np.clip(hidden @ file["kernel_1"], -1.0, 1.0)
    np.testing.assert_allclose(policy.mean(x), reference, atol=1e-5)
    policy.save(tmp_path / "again.npz")
    again = quadjax.Policy.load(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.mean(x), policy.mean(x))


def test_a_policy_file_without_a_config_flies_where_one_is_named(tmp_path, capsys):
    path, laps = own_policy(tmp_path / "own.npz"), tmp_path / "laps.json"
    words = ("--policy", path, "--runs", 2, "--gates", 1, "--deterministic", "--json", laps)
    assert run("evaluate", *words) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "own.npz: has no config; name the config of its race (CONFIG or --race CONFIG)" in error
    assert run("evaluate", "e2e", *words) == 0
    assert json.loads(laps.read_text())["runs"] == 2


def test_a_residual_file_of_numpy_alone(tmp_path):
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
