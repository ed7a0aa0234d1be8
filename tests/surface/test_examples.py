"""Every example runs as it is, with a shorter training, and has at most 40 lines of code."""

import ast
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest

import quadjax
from tests.docs.smaller import CODE, load_short, smaller

ROOT = Path(__file__).resolve().parents[2]
LEARNS = "pendulum"  # as it is, in tests/learners
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_there_is_an_example_for_each_thing_that_a_user_brings():
    names = {path.stem for path in EXAMPLES}
    own = {"track", "drone", "schedule", "learner", "vehicle", "reward_term", "observation", "rule"}
    own |= {"log_format", "autopilot"}
    assert {f"own_{name}" for name in own} | {"hello_world", "pendulum"} <= names


def test_examples_are_short_and_use_only_public_names():
    public = public_names()
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert sum(bool(line.strip()) for line in text.splitlines()) <= 40, path.name
        assert text.startswith('"""') and "._" not in text, path.name
        assert package_names(ast.parse(text)) <= public, path.name


def public_names() -> set[str]:
    """The names of ``quadjax``, and the objects that the pages of the reference describe."""
    pages = (ROOT / "docs" / "reference").glob("*.md")
    described = {x for p in pages for x in re.findall(r"^::: (\S+)", p.read_text("utf-8"), re.M)}
    return described | {f"quadjax.{name}" for name in quadjax.__all__} | {"quadjax"}


def package_names(tree: ast.Module) -> set[str]:
    """The full names of what a module takes from the package."""
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    names = {alias.name for node in imports for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "quadjax":
            names.add(f"quadjax.{node.attr}")
    return {name for name in names if name.split(".")[0] == "quadjax"}


def test_a_module_that_no_page_describes_is_not_public():
    tree = ast.parse(
        "import numpy, quadjax.race.laps\nfrom quadjax.core import vectors\nquadjax.Run"
    )
    names = {"quadjax.race.laps", "quadjax.core.vectors"}
    assert package_names(tree) == names | {"quadjax.Run"} and not names & public_names()


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [path for path in EXAMPLES if path.stem != LEARNS], ids=lambda path: path.stem
)
def test_an_example_runs(path, tmp_path, monkeypatch):
    shutil.copytree(path.parent, tmp_path, dirs_exist_ok=True)
    script = tmp_path / path.name
    script.write_text(smaller(path.read_text(encoding="utf-8"), CODE), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{tmp_path}")  # of the processes of an example
    monkeypatch.setattr(quadjax, "load", load_short)
    monkeypatch.setattr(sys, "argv", [path.name])
    for other in EXAMPLES:  # modules that a config names are imported from this folder
        monkeypatch.delitem(sys.modules, other.stem, raising=False)
    try:
        runpy.run_path(str(script), run_name="__main__")
    except SystemExit as end:
        assert not end.code
