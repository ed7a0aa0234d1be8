"""Every example runs as it is, with a shorter training, and has at most 40 lines of code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

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
def test_examples_are_short_and_use_only_public_modules(path):
    text = path.read_text(encoding="utf-8")
    assert sum(bool(line.strip()) for line in text.splitlines()) <= 40
    assert text.startswith('"""') and "._" not in text


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
