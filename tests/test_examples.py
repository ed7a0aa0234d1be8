"""Every example runs as it is, with a shorter training, and has at most 40 lines of code."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quadjax

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SMALLER = [
    (r"\bsteps=[\d_]+", "steps=1_024"),
    (r"\bruns=\d+", "runs=2"),
    (r"\bnum_envs=\d+", "num_envs=16"),
    (r"\bhorizon=\d+", "horizon=4"),
]
# Settings of a short training, for whatever quadjax.load returns.
PRELUDE = """
import sys, runpy, quadjax
load = quadjax.load
SHORT = ["run.steps=1024", "run.evaluate_every=512", "learner.num_envs=16", "network.hidden=[8]",
         "evaluate.laps=1", "run.devices=1"]
LEARNERS = {
    "ppo": ["learner.rollout_length=8", "learner.num_minibatches=2", "learner.num_epochs=1"],
    "shac": ["learner.horizon=4", "learner.critic_minibatches=2", "learner.critic_epochs=1"],
}
def short(name, overrides=()):
    algorithm = load(name, overrides).learner.algorithm
    return load(name, [*overrides, *SHORT, *LEARNERS.get(algorithm, [])])
quadjax.load = short
"""


def test_there_is_an_example_for_each_thing_that_a_user_brings():
    names = {path.stem for path in EXAMPLES}
    own = {"track", "drone", "schedule", "learner", "vehicle", "reward_term", "observation", "rule"}
    own |= {"log_format", "autopilot"}
    assert {f"own_{name}" for name in own} | {"hello_world", "pendulum"} <= names


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short_and_use_only_public_names(path):
    text = path.read_text(encoding="utf-8")
    assert sum(bool(line.strip()) for line in text.splitlines()) <= 40
    assert text.startswith('"""') and "._" not in text
    assert package_names(ast.parse(text)) <= public_names()


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
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path):
    code = path.read_text(encoding="utf-8")
    for pattern, value in SMALLER:
        code = re.sub(pattern, value, code)
    for other in path.parent.iterdir():
        (tmp_path / other.name).write_text(other.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / path.name).write_text(code, encoding="utf-8")
    runner = PRELUDE + f"runpy.run_path({path.name!r}, run_name='__main__')\n"
    paths = [str(ROOT), str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", runner],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
