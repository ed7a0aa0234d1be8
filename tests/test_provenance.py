"""The provenance of results."""

import hashlib
import shutil
import subprocess
from pathlib import Path

import quadjax
from quadjax.core import provenance as origins
from quadjax.core.provenance import provenance
from quadjax.core.resources import PRETRAINED
from quadjax.fitting.config import FitConfig

ROOT = Path(__file__).resolve().parents[1]
RESIDUAL = PRETRAINED / "standin_residual.npz"


def test_every_part_is_named_and_what_is_unknown_is_null():
    policy = PRETRAINED / "e2e_residual.npz"
    found = provenance(quadjax.load("e2e", ["seed=4"]), policy)
    assert found["quadjax"] == quadjax.__version__ and found["seed"] == 4
    assert found["jax"] and found["device"] and found["date"].endswith("+00:00")
    assert found["policy"]["sha256"] == hashlib.sha256(policy.read_bytes()).hexdigest()
    assert found["config"]["name"] == "e2e" and len(found["config"]["sha256"]) == 64
    empty = provenance()
    assert set(empty) == set(found)
    assert [empty[key] for key in ("config", "policy", "seed")] == [None] * 3
    assert provenance(FitConfig(seed=2), seed=3)["seed"] == 3


def test_the_commit_of_a_checkout_is_named(monkeypatch):
    """Two results of one version that were made by different code differ."""
    if (ROOT / ".git").exists() and shutil.which("git"):
        command = ["git", "-C", ROOT, "rev-parse", "HEAD"]
        head = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        assert provenance()["commit"].removesuffix("-dirty") == head
    monkeypatch.setenv("PATH", "")
    assert origins.commit.__wrapped__() is None  # without Git


def test_the_hash_of_a_config_counts_values_and_contents_of_files(tmp_path):
    def sha(residual, *overrides):
        config = quadjax.load("e2e", [f"vehicle.residual={residual}", *overrides])
        return provenance(config)["config"]["sha256"]

    copied = shutil.copy(RESIDUAL, tmp_path / "moved.npz")
    assert sha(RESIDUAL.name) == sha(RESIDUAL) == sha(copied)
    assert sha(RESIDUAL) != sha(RESIDUAL, "reward.gate=11")
    (tmp_path / "moved.npz").write_bytes(b"other")
    assert sha(copied) != sha(RESIDUAL)
