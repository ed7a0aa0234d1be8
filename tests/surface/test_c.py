"""Exported C: the commands of the policy, verification, and a race flown by the C of a target."""

import json
from pathlib import Path

import numpy as np
import pytest

import quadjax
from tests.commands import run


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The folder of a shipped policy, exported by the command."""
    folder = tmp_path_factory.mktemp("c") / "one"
    assert run("export", "e2e", "--output", folder, "--name", "policy") == 0
    return folder


@pytest.mark.slow
def test_a_shipped_policy_is_exported_verified_and_flies(exported, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("sil", exported, "--simulator", "--laps", 2) == 0  # in two commands
    result = json.loads(Path("runs/sil/sil.json").read_text())
    np.testing.assert_allclose(result["laps"], [[2.63, 2.24]], atol=0.05)
    assert run("verify", exported, "--vectors", 500, "--json", "verify.json") == 0
    results = json.loads(Path("verify.json").read_text())["results"]
    assert len(results) == 6 and "FAIL" not in {row["verdict"] for row in results}


@pytest.mark.slow
def test_python_exports_the_same_files_as_the_command(exported, tmp_path):
    quadjax.export_c(quadjax.Policy.load("e2e"), tmp_path / "two", name="policy")
    names = {p.relative_to(exported).as_posix() for p in exported.rglob("*.[ch]")}
    assert "paparazzi/policy.h" in names
    for name in names - {"paparazzi/policy.h"}:  # which has the hash of the policy file
        one, two = ((folder / name).read_text() for folder in (exported, tmp_path / "two"))
        assert one == two
    headers = [(x / "paparazzi/policy.h").read_text() for x in (exported, tmp_path / "two")]
    assert len({text[text.index("#include") :] for text in headers}) == 1
