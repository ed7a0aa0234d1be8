"""Exported C: the commands of the policy, verification, and a race flown by the C of a target."""

import json
from pathlib import Path

import numpy as np
import pytest

import quadjax
from tests.commands import run


@pytest.mark.slow
@pytest.mark.parametrize("target", ["cortex-a9", "qjp"])
def test_a_shipped_policy_is_exported_verified_and_flies(target, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("export", "e2e_nominal", "--output", "out", "--target", target) == 0
    assert run("sil", "out", "--simulator", "--laps", 2) == 0
    result = json.loads(Path("runs/sil/sil.json").read_text())
    np.testing.assert_allclose(result["laps"], [[2.63, 2.24]], atol=0.05)
    assert run("verify", "out", "--vectors", 500, "--json", "verify.json") == 0
    results = json.loads(Path("verify.json").read_text())["results"]
    assert len(results) == 9 and "fail" not in {row["verdict"] for row in results}


@pytest.mark.slow
def test_python_exports_the_same_files_as_the_command(tmp_path):
    assert run("export", "e2e_nominal", "--output", tmp_path / "one", "--name", "policy") == 0
    quadjax.export_c(quadjax.Policy.load("e2e_nominal"), tmp_path / "two", name="policy")
    names = {p.relative_to(tmp_path / "one").as_posix() for p in (tmp_path / "one").rglob("*.[ch]")}
    assert "paparazzi/policy.h" in names
    for name in names - {"paparazzi/policy.h"}:  # which has the hash of the policy file
        one, two = ((tmp_path / folder / name).read_text() for folder in ("one", "two"))
        assert one == two
    words = [(tmp_path / folder / "policy.qjp").read_bytes() for folder in ("one", "two")]
    assert words[0][-4000:-4] == words[1][-4000:-4]
