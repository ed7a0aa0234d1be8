"""Every example runs as it is, with a shorter training, and has at most 40 lines of code."""

import ast
import functools
import importlib
import shutil
import sys
from pathlib import Path

import pytest

import quadjax
from tests.docs.smaller import CODE, load_short, smaller
from tests.surface.names import inner_names

ROOT = Path(__file__).resolve().parents[2]
LEARNS = "07_pendulum"  # as it is, in tests/learners
KEPT = {"10_learn_from_flights": ("network.hidden",)}  # of the shipped policy that it fine-tunes
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_the_examples_are_numbered():
    topics = "lap train drone_and_track race vehicle_model learner pendulum log_format autopilot"
    topics += " learn_from_flights network loss memory"
    names = [f"{number:02}_{topic}" for number, topic in enumerate(topics.split(), 1)]
    assert [path.stem for path in EXAMPLES] == names


def test_examples_are_short_and_use_only_public_names():
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert sum(bool(line.strip()) for line in text.splitlines()) <= 40, path.name
        assert text.startswith('"""') and "\ndef main():\n" in text, path.name
        assert not inner_names(ast.parse(text)), path.name


def test_an_inner_module_is_not_public():
    tree = ast.parse(
        "import numpy, os, scipy, quadjax.race.laps\nfrom quadjax.core import vectors\n"
        "quadjax.Run\nquadjax.race\nx._y\nx.z"
    )
    inner = {"scipy", "quadjax.race.laps", "quadjax.core.vectors", "quadjax.race", "_y"}
    assert inner_names(tree) == inner


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [path for path in EXAMPLES if path.stem != LEARNS], ids=lambda path: path.stem
)
def test_an_example_runs(path, tmp_path, monkeypatch, capfd):
    shutil.copytree(path.parent, tmp_path, dirs_exist_ok=True)
    script = tmp_path / path.name
    script.write_text(smaller(path.read_text(encoding="utf-8"), CODE), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{tmp_path}")  # of the processes of an example
    short = functools.partial(load_short, kept=KEPT.get(path.stem, ()))
    monkeypatch.setattr(quadjax, "load", short)
    for other in EXAMPLES:  # also the modules that a config names are imported from this folder
        monkeypatch.delitem(sys.modules, other.stem, raising=False)
    assert not importlib.import_module(path.stem).main()
    assert capfd.readouterr().out.strip(), "an example prints what it does"
